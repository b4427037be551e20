"""Training streams: a few batches in memory, each rank its share, every frame once."""

import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.blob import make_object, ring_of_cameras
from helpers.plain import edit_json

from data_prep.pack import pack
from gausim.core import Cameras
from gausim.data import frames as frames_module
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SequenceSample
from gausim.data.records import SequenceRecord
from gausim.io.packed import view_path, write_header
from gausim.training.plan import TrainingPlan


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
