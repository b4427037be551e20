"""A run that dies anywhere and is started again leaves bit for bit what it would have left undisturbed."""

from __future__ import annotations

import csv
import json
import random
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers import toy_object
from helpers.simulators import LEVELS
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gausim.compose.build import load_run
from gausim.core import RunError
from gausim.runs.checkpoint import digest, read_checkpoint

TESTS = Path(__file__).parents[1]
TINY = (
    "model=gausim_paper", "model.simulator.network.layers=1", "model.simulator.network.hidden=8", LEVELS,
    "data.repeats=2", "data.curriculum.t_max=3", "data.curriculum.t_start=1", "trainer.convergence.held_back=1",
    "trainer.convergence.window=2", "optimizer.schedule.warmup=0.5", "data.batch_size=1",
    "render=reference", "optimizer.ema_decay=0.9", "loss.input_noise=0.001", "trainer=cpu", "trainer.threads=1",
    "trainer.progress=false", "trainer.log_every_n_steps=1", "callbacks.panels=null", "doctor=false",
)  # fmt: skip
SAVED = "gausim.runs.checkpoint._check_written"
STEP = "gausim.training.module.GausSimModule.training_step"

Train = Callable[..., "tuple[int, str]"]


@pytest.fixture(scope="module")
def train(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Train]:
    """Trains in a process of its own: name, overrides, and how it dies; returns the exit status and the output."""
    folder = tmp_path_factory.mktemp("runs")
    toy = toy_object.write_toy_object(folder / "toy").root
    given = (f"data.root={toy}", f"paths.output_root={folder}", *TINY)
    program = [sys.executable, str(TESTS / "helpers" / "killed_runs.py")]
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdin is not None and server.stdout is not None

        def order(name: str, *overrides: str, alone: bool = False, **death: Any) -> tuple[int, str]:
            argv = list(overrides) if alone else [*given, f"name={name}", *overrides]
            server.stdin.write(json.dumps({"argv": argv, **death}) + "\n")
            server.stdin.flush()
            found = json.loads(server.stdout.readline())
            return found["status"], found["output"]

        order.folder = folder  # type: ignore[attr-defined]
        yield order
        server.stdin.close()


def run_of(train: Train, name: str) -> Path:
    return train.folder / name / "seed_0"  # type: ignore[attr-defined]


def killed(target: str, count: int, match: str = "", when: str = "before") -> dict[str, Any]:
    return {"die": [{"target": target, "match": match, "count": count, "when": when}]}


def learned(run: Path) -> dict[str, str]:
    """Digests of all that a checkpoint holds, seconds aside."""
    loaded = read_checkpoint(run / "last.ckpt")
    kept = {k: v for k, v in loaded.items() if k not in ("callbacks", "cost", "digest")}
    return {f"{k}.{name}": digest(v) for k, entry in kept.items() for name, v in _parts(entry)}


def _parts(entry: Any) -> list[tuple[str, Any]]:
    return list(entry.items()) if isinstance(entry, dict) else [("", entry)]


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def curves(run: Path) -> dict[str, list[tuple[int, float]]]:
    events = EventAccumulator(str(run / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def assert_same_run(found: Path, expected: Path) -> None:
    assert learned(found) == learned(expected)
    for name in ("epochs.csv", "csv/metrics.csv"):
        rows = table(expected / name)
        assert len(rows) > 1 and table(found / name) == rows
    assert (found / "FINISHED").read_text() == (expected / "FINISHED").read_text()
    assert len(curves(expected)) > 10 and curves(found) == curves(expected)
    assert list(found.glob(".*.tmp")) == []


@pytest.fixture(scope="module")
def whole(train: Train) -> Path:
    status, output = train("whole", "trainer.max_epochs=4")
    assert status == 0, output
    assert read_checkpoint(run_of(train, "whole") / "last.ckpt")["global_step"] == 16
    return run_of(train, "whole")


def test_a_run_killed_again_and_again_equals_an_uninterrupted_one(train: Train, whole: Path) -> None:
    run = run_of(train, "cut")

    def go(**death: Any) -> tuple[int, str]:
        return train("cut", "trainer.max_epochs=4", "callbacks.checkpoint.every_steps=3", **death)

    def step() -> int:
        return read_checkpoint(run / "last.ckpt")["global_step"]

    # In the second step, before anything was saved: what the loggers hold is dropped.
    assert go(**killed(STEP, 2))[0] == -9
    assert not (run / "last.ckpt").exists()
    # While the second checkpoint (at the epoch's end, step 4) is being written.
    assert go(**killed(SAVED, 2))[0] == -9
    assert step() == 3 and list(run.glob(".last.ckpt.*.tmp"))
    # The disk takes no file as large as a checkpoint: a named error, and the last good one stays.
    status, output = go(limit=50_000)
    assert status == 2 and "last.ckpt: the checkpoint could not be written" in output and "File too large" in output
    assert step() == 3
    # Between naming the predecessor and the successor: resumed in the middle of an epoch, killed in the middle of one.
    assert go(**killed("os.replace", 3, match=".last.ckpt."))[0] == -9
    assert step() == 7 and read_checkpoint(run / "last.previous.ckpt")["global_step"] == 7
    assert go(**killed(STEP, 5))[0] == -9
    assert step() == 11 and read_checkpoint(run / "last.previous.ckpt")["global_step"] == 8
    # The newest is torn: the one before it serves.
    (run / "last.ckpt").write_bytes((run / "last.ckpt").read_bytes()[:-20_000])
    status, output = go(**killed("gausim.runs.directory.RunDirectory.finish", 1))
    assert status == -9 and f"{run}/last.ckpt" in output and f"Resuming from {run}/last.previous.ckpt" in output
    # Trained to the end, but not marked as finished.
    assert step() == 16 and not (run / "FINISHED").exists()
    status, output = go()
    assert status == 0, output
    assert_same_run(run, whole)


def test_a_run_created_again_from_its_saved_config_is_equal(train: Train, whole: Path) -> None:
    folder = whole.parents[1] / "again" / "seed_0"
    config = ("--config-dir", str(whole), "--config-name", "config", f"hydra.run.dir={folder}")
    status, output = train("again", *config, alone=True)
    assert status == 0, output
    assert_same_run(folder, whole)


def test_what_a_module_loads_is_what_it_saves(whole: Path) -> None:
    module = load_run(whole).module
    loaded, saved = read_checkpoint(whole / "last.ckpt"), dict[str, Any]()
    module.on_load_checkpoint(loaded)
    module.on_save_checkpoint(saved)
    kept = loaded["gausim"]
    assert {"average", "epoch", "baselines"} < set(kept) and all(kept["epoch"]["sums"].values())
    assert {k: digest(v) for k, v in saved["gausim"].items()} == {k: digest(v) for k, v in kept.items()}


def test_a_run_whose_time_was_up_is_not_trained_further(train: Train) -> None:
    short = ("trainer.max_minutes=0.001", "trainer.clock=cpu", "trainer.max_epochs=400")
    assert train("short", *short, **killed("gausim.runs.directory.RunDirectory.finish", 1))[0] == -9
    run = run_of(train, "short")
    before = learned(run)
    status, output = train("short", *short)
    assert status == 0, output
    assert learned(run) == before
    finished = json.loads((run / "FINISHED").read_text())
    assert 0 < finished["epochs"] < 400 and finished["last_epoch"]["steps"] >= 1
    assert len(table(run / "epochs.csv")) == finished["epochs"]


def test_a_directory_that_cannot_be_written_is_named(train: Train) -> None:
    status, output = train("denied", "paths.output_root=/sys/gausim")  # not even by the superuser
    assert status == 2 and output.strip().splitlines()[-1].startswith("error: /sys/gausim"), output
    assert "Traceback" not in output


@pytest.mark.slow
def test_twenty_kills_at_random_moments(train: Train) -> None:
    settings = ("trainer.max_epochs=100", "render=cpu", "data.repeats=5")
    status, output = train("undisturbed", *settings)
    assert status == 0, output
    moments, kills, steps, seen, patience = random.Random(0), 0, set(), 0, 1.0
    run = run_of(train, "disturbed")
    while kills < 20:
        every = f"callbacks.checkpoint.every_steps={moments.choice((1, 3, 7))}"
        status, output = train("disturbed", *settings, every, kill_after=patience * moments.uniform(0.5, 2.5))
        assert status in (-9, 0), output
        if status == 0:
            break
        kills += 1
        before, seen = seen, read_checkpoint(run / "last.ckpt")["global_step"] if (run / "last.ckpt").exists() else 0
        steps |= {seen % 10} if seen else set()
        # On a busy machine every life would end before its first step, on a fast one the run before its last death.
        patience *= 1.3 if seen == before else 0.6 if seen > before + 12 else 1.0
    status, output = train("disturbed", *settings) if status else (status, output)
    assert status == 0, output
    assert kills == 20, f"only {kills} kills before the run ended: lengthen it"
    assert len(steps) > 3, f"killed at {steps} of an epoch's 10 steps: too few different places"
    assert_same_run(run, run_of(train, "undisturbed"))


def test_the_comparison_sees_one_bit(whole: Path, tmp_path: Path) -> None:
    loaded = read_checkpoint(whole / "last.ckpt")
    before = digest(loaded)
    name, weight = next(iter(loaded["state_dict"].items()))
    weight.view(-1)[:1] += 1e-6 * weight.view(-1)[:1].abs() + 1e-30
    assert digest(loaded) != before, name
    with pytest.raises(RunError, match="no such checkpoint"):
        read_checkpoint(tmp_path / "last.ckpt")
