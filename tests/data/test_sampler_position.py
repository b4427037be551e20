from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from gausim.data.curriculum import Curriculum
from gausim.data.datamodule import ReadyDataModule
from gausim.data.sampler import SequenceBatchSampler


def sampler(curriculum: Curriculum | None = None) -> SequenceBatchSampler:
    return SequenceBatchSampler(5, batch_size=2, repeats=3, seed=4, curriculum=curriculum or Curriculum())


@pytest.mark.parametrize("done", range(9))
def test_an_epoch_goes_on_at_every_position_and_the_next_begins_at_its_beginning(done: int) -> None:
    whole = sampler()
    whole.set_epoch(1)
    expected = list(whole)
    whole.set_epoch(2)
    following = list(whole)
    resumed = sampler()
    resumed.load_state_dict({"epoch": 1, "position": done})
    if done < len(expected):
        resumed.set_epoch(1)  # Lightning announces the epoch that is under way again
        assert list(resumed) == expected[done:]
    resumed.set_epoch(2)
    assert list(resumed) == following


def test_the_number_of_steps_is_that_of_the_resumed_epoch() -> None:
    resumed = sampler(Curriculum(t_max=9))
    resumed.load_state_dict({"epoch": 6, "position": 7})
    assert {key.steps for batch in resumed for key in batch} == {7}


def test_what_a_loader_fetched_ahead_is_not_counted_as_trained(blob: Path) -> None:
    data = ReadyDataModule(blob, repeats=2)
    data.setup("fit")
    ahead = iter(data.train_dataloader())
    seen = [next(ahead)[0].sequence_id for _ in range(4)]
    progress = SimpleNamespace(current=SimpleNamespace(ready=2))
    loops = SimpleNamespace(epoch_loop=SimpleNamespace(batch_progress=progress))
    data.trainer = SimpleNamespace(fit_loop=loops, global_rank=0, world_size=1)  # type: ignore[assignment]
    state = data.state_dict()
    assert state == {"epoch": 0, "position": 2}
    resumed = ReadyDataModule(blob, repeats=2)
    resumed.load_state_dict(state)
    assert [batch[0].sequence_id for batch in resumed.train_dataloader()][:2] == seen[2:]


def test_a_loader_leaves_the_global_generator_alone(blob: Path) -> None:
    data = ReadyDataModule(blob)
    before = torch.get_rng_state()
    list(data.train_dataloader())
    assert torch.equal(torch.get_rng_state(), before)
