import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.blob import make_object, ring_of_cameras
from helpers.plain import edit_json

from data_prep.pack import pack
from gausim.core import Cameras, ConfigError, DataError
from gausim.data import frames as frames_module
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SampleKey, SequenceIndex, SequenceSample
from gausim.data.objects import ObjectData
from gausim.data.records import SequenceRecord
from gausim.data.sampler import SequenceBatchSampler
from gausim.io.packed import view_path, write_header
from gausim.training.plan import TrainingPlan
from gausim.training.ranks.ranks import interleave


def plan(**options: Any) -> TrainingPlan:
    return TrainingPlan(**{"repeats": 1, "batch_size": 2, "t_start": 1, "t_max": 15, **options})


def sampler(batch_size: int = 2, **options: int) -> SequenceBatchSampler:
    return SequenceBatchSampler(5, plan=plan(repeats=3, batch_size=batch_size), **{"seed": 4, **options})


def test_training_cannot_hand_out_unseen_frames_and_heldout_views(blob: Path) -> None:
    index = SequenceIndex([ObjectData(blob)])
    sample = index[SampleKey(1, 15)]
    assert sample.frames.shape[0] == 16 and sample.frames[:, :, -1, -1, 2].amax() == 15 + 3  # a frame tells its number
    assert sample.cameras.names == ("cam_0", "cam_1")
    assert sorted(set(sample.frames[..., -1, -1, 1].flatten().tolist())) == [2, 22]  # views 0 and 1, never 2
    for steps in (16, 0, -1):
        with pytest.raises(DataError, match="predicted steps asked for"):
            index[SampleKey(1, steps)]


def test_what_a_loader_fetched_ahead_is_not_counted_as_trained(blob: Path) -> None:
    data = ReadyDataModule(blob, plan=plan(repeats=2, batch_size=1))
    data.setup("fit")
    ahead = iter(data.train_dataloader())
    seen = [next(ahead)[0].sequence_id for _ in range(4)]
    progress = SimpleNamespace(current=SimpleNamespace(ready=2))
    loops = SimpleNamespace(epoch_loop=SimpleNamespace(batch_progress=progress))
    data.trainer = SimpleNamespace(fit_loop=loops, global_rank=0, world_size=1)  # type: ignore[assignment]
    state = data.state_dict()
    assert state == {"epoch": 0, "position": 2}
    resumed = ReadyDataModule(blob, plan=plan(repeats=2, batch_size=1))
    resumed.load_state_dict(state)
    assert [batch[0].sequence_id for batch in resumed.train_dataloader()][:2] == seen[2:]


def test_epochs_are_even_and_ranks_want_a_sequence_each() -> None:
    for epoch in range(20):
        one = sampler()
        one.set_epoch(epoch)
        batches = list(one)
        assert len(batches) == len(one) == 8
        assert sorted(k.sequence for b in batches for k in b) == sorted(list(range(5)) * 3)
        assert all(len({k.sequence for k in b}) == len(b) for b in batches)
        assert {k.steps for b in batches for k in b} == {plan().steps(epoch)}
    with pytest.raises(ConfigError, match=r"plan.batch_size: .* each of the 3 ranks, got 2 .*plan.batch_size=3"):
        sampler(batch_size=2, rank=0, world_size=3)


@pytest.mark.parametrize("done", [0, 3, 8])
def test_an_epoch_goes_on_at_every_position_and_the_next_begins_at_its_beginning(done: int) -> None:
    whole, resumed = sampler(), sampler()
    whole.set_epoch(1)
    expected = list(whole)
    whole.set_epoch(2)
    resumed.load_state_dict({"epoch": 1, "position": done})
    if done < len(expected):
        resumed.set_epoch(1)  # Lightning announces the epoch that is under way again
        assert list(resumed) == expected[done:]
        assert {key.steps for batch in expected for key in batch} == {2}
    resumed.set_epoch(2)
    assert list(resumed) == list(whole)


@pytest.mark.parametrize("world", [2, 4])
def test_ranks_divide_the_batches_of_one_rank(world: int) -> None:
    size = 4
    alone = list(sampler(batch_size=size))
    assert [len(batch) for batch in alone] == [4, 4, 4, 3]
    shares = [list(sampler(batch_size=size, rank=r, world_size=world)) for r in range(world)]
    assert all(len(share) == len(alone) for share in shares)  # as many steps everywhere
    for number, batch in enumerate(alone):
        held = [share[number] for share in shares]
        assert interleave(held) == batch  # nothing twice, nothing left out
    assert [len(share[-1]) for share in shares] == {2: [2, 1], 4: [1, 1, 1, 0]}[world]


def test_samples_of_several_objects_are_numbered_through(mixed: Path) -> None:
    data = ReadyDataModule(mixed, plan=plan(batch_size=5, t_max=5))
    data.setup("fit")
    assert [o.name for o in data.objects] == ["apple", "pear"] and len(data.index) == 5
    (batch,) = list(data.train_dataloader())
    found = sorted((s.sequence_id, s.scene_id, s.object_name, s.sequence_name, s.steps) for s in batch)
    names = [(0, "apple", f"seq_00{i}") for i in range(3)] + [(1, "pear", f"seq_00{i}") for i in range(2)]
    assert found == [(number, *name, 1) for number, name in enumerate(names)]
    assert all(s.frames.dtype == torch.uint8 and s.frames.shape == (2, 2 - s.scene_id, 6, 8, 4) for s in batch)


def test_roots_that_are_not_there(mixed: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data.root: no directory .* data.root=PATH"):
        _ = ReadyDataModule(None).objects
    with pytest.raises(DataError, match="gausim prepare synthesize"):
        _ = ReadyDataModule(tmp_path / "none").objects
    with pytest.raises(ConfigError, match=r"data.names: \['plum'\] asked for, the roots hold"):
        _ = ReadyDataModule(mixed, names=["plum"]).objects
    with pytest.raises(ConfigError, match="each name once"):
        _ = ReadyDataModule([mixed / "pear", mixed / "pear"]).objects
    with pytest.raises(ConfigError, match="unknown key"):
        _ = ReadyDataModule([{"root": mixed, "scen": "x"}]).objects
    with pytest.raises(ConfigError, match="of one object"):
        _ = ReadyDataModule(mixed, scene="x.ply").objects


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two objects; the second has other cameras, rate and lengths of sequences."""
    root = tmp_path_factory.mktemp("mixed")
    make_object(root / "apple", name="apple", sequences=3)
    pear = make_object(root / "pear", name="pear", sequences=2)

    def fewer(data: dict) -> None:
        data.update(views=["cam_0", "cam_1"], train_views=["cam_0"], heldout_views=["cam_1"], fps=50,
                    train_frames=[0, 9])  # fmt: skip

    edit_json(pear / "dataset.json", fewer)
    for number, count in enumerate((9, 14)):

        def shorter(data: dict, count: int = count) -> None:
            data["fps"] = 50
            data["frames"] = [f for f in data["frames"] if f["camera"] != "cam_2" and f["frame"] < count]

        edit_json(pear / "sequences" / f"seq_{number:03d}" / "transforms.json", shorter)
    return root


def stream(root: Path | list[Path], **options: object) -> ReadyDataModule:
    course: dict = {"batch_size": 2, "repeats": 1, "t_start": 1, "t_max": 5}
    course |= {name: options.pop(name) for name in list(options) if name in course}
    data = ReadyDataModule(root, plan=TrainingPlan(**course), **options)  # type: ignore[arg-type]
    data.setup("fit")
    return data


def batches(data: ReadyDataModule, number: int) -> Iterator[list[SequenceSample]]:
    """The batches of an epoch."""
    loader = data.train_dataloader()
    loader.batch_sampler.set_epoch(number)  # type: ignore[union-attr]
    yield from loader


def shown(data: ReadyDataModule, number: int) -> list[list[tuple[int, int]]]:
    """Sequence and last frame of every sample of an epoch; frames carry their number."""
    return [[(s.sequence_id, int(s.frames[-1, 0, -1, -1, 2]) - 3) for s in batch] for batch in batches(data, number)]


def test_reading_ahead_changes_nothing(mixed: Path) -> None:
    plain, ahead = stream(mixed, repeats=3), stream(mixed, prefetch=2, repeats=3)
    for number in (0, 2):
        found = shown(ahead, number)
        assert found == shown(plain, number) and len(found) == 8
        # The last frame that a sample shows is T = epoch + 1.
        assert {last for batch in found for _, last in batch} == {number + 1}


def test_memory_does_not_grow_with_the_set(tmp_path: Path) -> None:
    """A packed set of ten batches: over three epochs no more than two of them are in memory."""
    root = make_object(tmp_path / "large", sequences=1)
    sequences, frames, views, side = 10, 16, ("cam_0", "cam_1", "cam_2"), 160
    (root / "sequences" / "seq_000").rename(tmp_path / "small")
    cameras = ring_of_cameras(views, width=side, height=side)
    for number in range(sequences):
        _sparse_sequence(root / "sequences" / f"seq_{number:03d}", cameras, frames, side)
    data = stream(root, batch_size=1, t_start=15, t_max=15)
    batch = frames * 2 * 4 * side * side  # two training views
    tracemalloc.start()
    try:
        peaks = []
        for number in range(3):
            tracemalloc.reset_peak()
            assert sum(len(b) for b in batches(data, number)) == sequences
            peaks.append(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()
    # The old one while the new one is read.
    assert max(peaks) < 2.5 * batch < sequences * batch / 2


def _sparse_sequence(folder: Path, cameras: Cameras, frames: int, side: int) -> None:
    folder.mkdir(parents=True)
    for view in range(3):
        np.lib.format.open_memmap(view_path(folder, view), mode="w+", dtype=np.uint8, shape=(frames, side, side, 4))
    write_header(folder, cameras, [(0, 0)] * 3, 24.0)


def test_a_rank_reads_only_its_share(mixed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[tuple[str, str]] = []
    original = SequenceRecord.frames

    def noted(self: SequenceRecord, *args: object) -> object:
        read.append((self.root.parent.parent.name, self.name))
        return original(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(SequenceRecord, "frames", noted)
    shares = []
    for rank in range(2):
        data = ReadyDataModule(mixed, plan=TrainingPlan(batch_size=3, repeats=1, t_start=1, t_max=5))
        data.trainer = SimpleNamespace(global_rank=rank, world_size=2)  # type: ignore[assignment]
        data.setup("fit")
        read.clear()
        share = [(s.object_name, s.sequence_name) for batch in data.train_dataloader() for s in batch]
        assert sorted(read) == sorted(share) and len(set(read)) == len(read)
        shares += share
    assert sorted(shares) == [*(("apple", f"seq_{i:03d}") for i in range(3)), ("pear", "seq_000"), ("pear", "seq_001")]


def test_a_growing_rollout_reads_no_frame_twice(mixed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[Path] = []
    original = frames_module.read_rgba_into

    def noted(paths: list[Path], *args: object) -> None:
        decoded.extend(paths)
        original(paths, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(frames_module, "read_rgba_into", noted)
    data = stream(mixed, repeats=2)
    for number in range(6):
        list(batches(data, number))
        assert len(set(decoded)) == len(decoded) == (number + 2 if number < 5 else 6) * (3 * 2 + 2 * 1)


def test_a_packed_and_an_unpacked_object_train_together(mixed: Path, tmp_path: Path) -> None:
    pack(mixed / "pear", tmp_path / "pear")
    both, half = stream(mixed), stream([mixed / "apple", tmp_path / "pear"])
    for number in (0, 3):
        for one, other in zip(_whole(both, number), _whole(half, number), strict=True):
            assert one[0] == other[0] and torch.equal(one[1], other[1])


def _whole(data: ReadyDataModule, number: int) -> list[tuple[str, torch.Tensor]]:
    # Colours of fully transparent pixels are not kept by packing.
    return [(s.sequence_name, s.frames * (s.frames[..., 3:] > 0)) for batch in batches(data, number) for s in batch]
