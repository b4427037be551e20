"""A run that dies anywhere and is started again leaves bit for bit what it would have left undisturbed."""

import json
import random
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.toy_runs import Trainings, assert_same_run, killed, learned, rows
from lightning.pytorch import LightningModule, Trainer

from gausim.runs.checkpoint import read_checkpoint
from gausim.runs.cost import TrainingCost
from gausim.runs.randomness import random_state, restore_random_state
from gausim.training.callbacks.resume import RunCheckpoint

SAVED = "gausim.runs.checkpoint.read_checkpoint"
STEP = "gausim.training.module.GausSimModule.training_step"
THREE = ("trainer=cpu", "plan.epochs=3")


def step_of(run: Path, name: str = "last.ckpt") -> int:
    return read_checkpoint(run / name)["global_step"]


def test_a_run_killed_while_it_saves_equals_an_uninterrupted_one(trainings: Trainings, toy_run: Path) -> None:
    kept = read_checkpoint(toy_run / "last.ckpt")["gausim"]
    assert {"epoch", "baselines"} < set(kept) and all(kept["epoch"]["sums"].values())
    assert step_of(toy_run) == 18
    run, settings = trainings.run("cut"), (*THREE, "trainer.checkpoint_steps=4")
    # Between naming the predecessor and the successor of the checkpoint at the end of the second epoch.
    assert trainings("cut", *settings, **killed("os.replace", 4, match=".last.ckpt."))[0] == -9
    assert not (run / "last.ckpt").exists() and step_of(run, "last.previous.ckpt") == 10
    status, output = trainings("cut", *settings)
    assert status == 0 and "resuming on cpu (1 torch thread)" in output, output
    assert_same_run(run, toy_run)


def test_a_run_asked_to_end_does_so_and_a_place_that_cannot_be_written_is_named(trainings: Trainings) -> None:
    assert trainings("asked", *THREE, **killed(STEP, 2, by="SIGTERM"))[0] == -15
    status, output = trainings("denied", "output_root=/sys/gausim")  # not even by the superuser
    assert status == 2 and output.strip().splitlines()[-1].startswith("error: /sys/gausim"), output
    assert "Traceback" not in output


@pytest.mark.slow
def test_a_run_killed_again_and_again_equals_an_uninterrupted_one(trainings: Trainings, toy_run: Path) -> None:
    run = trainings.run("often")

    def go(**death: Any) -> tuple[int, str]:
        return trainings("often", *THREE, "trainer.checkpoint_steps=4", **death)

    # In the second step, before anything was saved: what the loggers hold is dropped.
    assert go(**killed(STEP, 2))[0] == -9
    assert not (run / "last.ckpt").exists()
    # While the second checkpoint (at the epoch's end, step 6) is being written.
    assert go(**killed(SAVED, 2))[0] == -9
    assert step_of(run) == 4 and list(run.glob(".last.ckpt.*.tmp"))
    # The disk takes no file as large as a checkpoint: a named error, and the last good one stays.
    status, output = go(limit=50_000)
    assert status == 2 and "last.ckpt: the checkpoint could not be written" in output and "File too large" in output
    assert step_of(run) == 4
    assert go(**killed(STEP, 7))[0] == -9
    assert step_of(run) == 10 and step_of(run, "last.previous.ckpt") == 6
    # The newest is torn: the one before it serves. Trained to the end, but not marked as finished.
    (run / "last.ckpt").write_bytes((run / "last.ckpt").read_bytes()[:-20_000])
    status, output = go(**killed("gausim.runs.directory.RunDirectory.finish", 1))
    assert status == -9 and f"Resuming from {run}/last.previous.ckpt" in output
    assert step_of(run) == 18 and not (run / "FINISHED").exists()
    status, output = go()
    assert status == 0, output
    assert_same_run(run, toy_run)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["falling", "held"])
def test_a_moving_body_killed_again_and_again_equals_an_uninterrupted_one(trainings: Trainings, kind: str) -> None:
    template = "model.simulator.template"
    settings = (*THREE, "model=gausim", trainings.moving(kind), f"{template}.modes=6", f"{template}.solid.spacing=0.3",
                "trainer.checkpoint_steps=2")  # fmt: skip
    whole, run = trainings.whole(f"whole_{kind}", *settings), trainings.run(kind)
    for deaths, death in enumerate((killed(STEP, 2), killed(SAVED, 2), killed(STEP, 3, when="after"), killed(STEP, 4))):
        status, output = trainings(kind, *settings, **death)
        assert status == -9, output
        assert (run / "last.ckpt").exists() == (deaths > 0)
    status, output = trainings(kind, *settings)
    assert status == 0 and "resuming" in output, output
    assert_same_run(run, whole)
    trained = {name for name in read_checkpoint(run / "last.ckpt")["state_dict"] if "surroundings" in name}
    assert len(trained) == (3 if kind == "falling" else 0)


def test_a_run_created_again_from_its_saved_config_is_equal(trainings: Trainings, toy_run: Path) -> None:
    folder = trainings.run("again")
    config = ["--config-dir", str(toy_run), "--config-name", "config", f"hydra.run.dir={folder}"]
    status, output = trainings.order(config)
    assert status == 0, output
    assert_same_run(folder, toy_run)


@pytest.mark.slow
def test_a_run_whose_time_was_up_is_not_trained_further(trainings: Trainings) -> None:
    short = ("trainer=cpu", "plan.max_minutes=0.001", "plan.clock=cpu", "plan.epochs=400")
    assert trainings("short", *short, **killed("gausim.runs.directory.RunDirectory.finish", 1))[0] == -9
    run = trainings.run("short")
    before = learned(run)
    status, output = trainings("short", *short)
    assert status == 0, output
    assert learned(run) == before
    finished = json.loads((run / "FINISHED").read_text())
    assert 0 < finished["epochs"] < 400 and finished["last_epoch"]["steps"] >= 1
    assert len(rows(run / "epochs.csv")) == finished["epochs"]


@pytest.mark.slow
def test_twenty_kills_at_random_moments(trainings: Trainings) -> None:
    settings = ("trainer=cpu", "plan.epochs=100", "render=cpu", "plan.repeats=4")
    undisturbed = trainings.whole("undisturbed", *settings)
    moments, kills, steps, seen, patience = random.Random(0), 0, set(), 0, 0.6
    run, status, output = trainings.run("disturbed"), -9, ""
    while kills < 20:
        every = f"trainer.checkpoint_steps={moments.choice((1, 3, 7))}"
        death = {"kill_after": patience * moments.uniform(0.5, 1.5)}
        status, output = trainings("disturbed", *settings, every, **death)
        assert status in (-9, 0), output
        if status == 0:
            break
        kills += 1
        before, seen = seen, step_of(run) if (run / "last.ckpt").exists() else 0
        steps |= {seen % 12} if seen else set()
        # On a busy machine every life would end before its first step, on a fast one the run before its last death.
        patience *= 1.3 if seen == before else 0.6 if seen > before + 40 else 1.0
    status, output = trainings("disturbed", *settings) if status else (status, output)
    assert status == 0, output
    assert kills == 20, f"only {kills} kills before the run ended: lengthen it"
    assert len(steps) > 3, f"killed at {steps} of an epoch's 12 steps: too few different places"
    assert_same_run(run, undisturbed)


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
