from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers.blob import make_object

from gausim.core import ConfigError, DataError
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SampleKey, SequenceIndex
from gausim.data.objects import ObjectData
from gausim.data.sampler import SequenceBatchSampler
from gausim.training.plan import TrainingPlan
from gausim.training.ranks.ranks import interleave


@pytest.fixture(scope="module")
def two_objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("set")
    make_object(root / "apple", name="apple", sequences=2)
    make_object(root / "pear", name="pear", sequences=3)
    return root


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


def test_samples_of_several_objects_are_numbered_through(two_objects: Path) -> None:
    data = ReadyDataModule(two_objects, plan=plan(batch_size=5))
    data.setup("fit")
    assert [o.name for o in data.objects] == ["apple", "pear"] and len(data.index) == 5
    (batch,) = list(data.train_dataloader())
    found = {s.sequence_id: (s.scene_id, s.object_name, s.sequence_name, s.steps) for s in batch}
    assert found == {
        0: (0, "apple", "seq_000", 1),
        1: (0, "apple", "seq_001", 1),
        2: (1, "pear", "seq_000", 1),
        3: (1, "pear", "seq_001", 1),
        4: (1, "pear", "seq_002", 1),
    }
    assert all(s.frames.dtype == torch.uint8 and s.frames.shape == (2, 2, 6, 8, 4) for s in batch)


def test_roots_that_are_not_there(two_objects: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data.root: no directory .* data.root=PATH"):
        _ = ReadyDataModule(None).objects
    with pytest.raises(DataError, match="gausim prepare synthesize"):
        _ = ReadyDataModule(tmp_path / "none").objects
    with pytest.raises(ConfigError, match=r"data.names: \['plum'\] asked for, the roots hold"):
        _ = ReadyDataModule(two_objects, names=["plum"]).objects
    with pytest.raises(ConfigError, match="each name once"):
        _ = ReadyDataModule([two_objects / "pear", two_objects / "pear"]).objects
    with pytest.raises(ConfigError, match="unknown key"):
        _ = ReadyDataModule([{"root": two_objects, "scen": "x"}]).objects
    with pytest.raises(ConfigError, match="of one object"):
        _ = ReadyDataModule(two_objects, scene="x.ply").objects
