"""The parts of an exact resume, each by itself."""

import random
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import LightningModule, Trainer

from gausim.runs.cost import TrainingCost
from gausim.runs.randomness import random_state, restore_random_state
from gausim.training.callbacks.resume import RunCheckpoint

MODULE = LightningModule()


def draws() -> list[float]:
    own = [random.random(), random.gauss(0, 1), float(np.random.rand()), float(np.random.randn())]
    return [*own, *torch.rand(2).tolist(), float(torch.randn(()))]


def test_random_generators_go_on_where_they_were(tmp_path: Path) -> None:
    outside = random_state()
    try:
        random.gauss(0, 1), np.random.randn()  # each keeps a second number back
        torch.save(random_state(), tmp_path / "state.pt")
        expected = draws()
        assert draws() != expected
        restore_random_state(torch.load(tmp_path / "state.pt", weights_only=True))
        assert draws() == expected
    finally:
        restore_random_state(outside)


def trainer_at(step: int, *, epoch: int = 0, last: bool = False, folder: Path = Path()) -> Any:
    """A trainer as callbacks see it, without the machinery (whose properties cannot be set)."""
    saved: list[int] = []  # steps; -1 is what the loggers hold
    seen = {
        "global_step": step, "is_last_batch": last, "should_stop": False, "current_epoch": epoch, "max_epochs": 9,
        "loggers": [SimpleNamespace(save=lambda: saved.append(-1))], "default_root_dir": str(folder),
        "strategy": SimpleNamespace(broadcast=lambda x: x),
        "is_global_zero": True, "saved": saved, "save_checkpoint": lambda *_, **__: saved.append(step),
    }  # fmt: skip
    return object.__new__(type("StandIn", (Trainer,), seen))


def test_saves_come_by_steps_and_by_minutes_within_an_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])

    def steps_saved(callback: RunCheckpoint, *, last: int | None = None) -> list[int]:
        now[0] = 0.0
        callback.on_train_start(trainer_at(0), MODULE)
        found = []
        for step in range(1, 13):
            now[0] += 20.0
            trainer = trainer_at(step, last=step == last)
            callback.on_train_batch_end(trainer, MODULE, None, None, 0)
            found += trainer.saved
        return found

    # What was logged is on the disk before the checkpoint is: a resumed run does not log it again.
    assert steps_saved(RunCheckpoint()) == [-1, 3, -1, 6, -1, 9, -1, 12]  # a minute
    assert steps_saved(RunCheckpoint(every_minutes=0)) == []
    assert steps_saved(RunCheckpoint(every_minutes=0, every_steps=5)) == [-1, 5, -1, 10]
    assert steps_saved(RunCheckpoint(every_minutes=0, every_steps=5), last=5) == [-1, 6, -1, 11]  # its end saves that


def test_cost_goes_on_where_a_checkpoint_ended() -> None:
    cost = TrainingCost()
    assert cost.notes() == [] and set(cost.summary().values()) == {0.0}
    time.sleep(0.05)
    first = cost.state_dict()
    assert 0.05 <= first["seconds"] < 5 and first["peak_bytes"] > 1e7 and first["cpu_seconds"] < first["seconds"]
    later = TrainingCost()
    later.load_state_dict({**first, "seconds": 120.0, "cpu_seconds": 90.0})
    later.begin()
    wall, processor = time.perf_counter(), time.process_time()
    while min(time.perf_counter() - wall, time.process_time() - processor) < 0.06:
        torch.rand(1000).sort()
    second = later.state_dict()
    assert second["seconds"] >= 120.05 and 90.05 <= second["cpu_seconds"] < 95
    assert second["peak_bytes"] >= first["peak_bytes"] and second == later.summary()
    assert later.notes() == [
        f"Trained in 2.0 minutes, 1.5 of processor time; it held {second['peak_bytes'] / 1e9:.1f} GB at most."
    ]
