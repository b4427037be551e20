"""A sweep that dies, fails or meets another process goes on by its own command; each run is made once."""

import json
import os
import random
from collections import Counter
from pathlib import Path
from typing import Any

import hydra
import pytest
from helpers.plain import digest
from helpers.toy_object import write_toy_object
from helpers.toy_runs import Trainings
from helpers.toy_runs import killed as dying
from hydra.core.hydra_config import HydraConfig

from gausim.compose import root as _conf
from gausim.runs.checkpoint import read_checkpoint
from gausim.runs.files import sole_writer

FINISH = "gausim.runs.directory.RunDirectory.finish"
SAVED = "gausim.runs.checkpoint.read_checkpoint"
STEP = "gausim.training.module.GausSimModule.training_step"


class Sweeps:
    """Sweeps of a toy object: name, overrides, and how it dies; gives exit status and output."""

    def __init__(self, trainings: Trainings) -> None:
        self.toy, *given = trainings.given
        self._order, self._folder = trainings.order, trainings.folder
        self._given = ("-m", *given, "data.sequences=2", "plan.t_max=2", "plan.epochs=2", "trainer=cpu", "logger=none")

    def __call__(self, name: str, *overrides: str, **death: Any) -> tuple[int, str]:
        return self._order([*self._given, self.toy, f"name=sweep_{name}", *overrides], **death)

    def runs(self, name: str) -> list[Path]:
        return sorted((self._folder / f"sweep_{name}").rglob("seed_*"))


@pytest.fixture(scope="module")
def do(trainings: Trainings) -> Sweeps:
    return Sweeps(trainings)


def history(run: Path) -> list[str]:
    """The events of a run."""
    return [json.loads(line)["event"] for line in (run / "events.jsonl").read_text().splitlines()]


def steps(run: Path) -> int:
    assert not (run / "FAILED").exists()
    return json.loads((run / "FINISHED").read_text())["optimizer_steps"]


def test_a_killed_sweep_goes_on_where_it_was_and_leaves_out_what_is_not_its_own(do: Sweeps) -> None:
    assert do("cut", "seed=0,1", **dying(FINISH, 2))[0] == -9
    status, output = do("cut", "seed=0,1")
    assert status == 0 and "sweep of 2 jobs: 1 trained, 1 finished before" in output, output
    first, second = do.runs("cut")
    assert f"left out, finished before: {first}" in output and f"left out, finished before: {second}" not in output
    expected = [["started", "finished"], ["started", "resumed", "finished"]]
    assert [history(run) for run in (first, second)] == expected and steps(first) == steps(second) == 8
    # Another process trains the second; the first is a run of another configuration, unharmed by being refused.
    (second / "FINISHED").unlink()
    config = (first / "config.yaml").read_text()
    (first / "config.yaml").write_text(config.replace("epochs: 2", "epochs: 3"))
    with sole_writer(second / ".lock"):
        status, output = do("cut", "seed=0,1")
    assert status == 2 and f"left out, {second}: another process" in output, output
    assert "1 trained by another process, 1 failed" in output and "changed: plan.epochs" in output
    assert [history(run) for run in (first, second)] == expected and steps(first) == 8


@pytest.mark.slow
def test_a_job_that_fails_before_its_first_step_stops_no_other_and_leaves_nothing(do: Sweeps, tmp_path: Path) -> None:
    late = tmp_path / "late"
    swept = (do.toy.replace("=", f"={late},"), "seed=0")
    status, output = do("mixed", *swept)
    assert status == 2 and "sweep of 2 jobs: 1 trained, 1 failed" in output, output
    assert f"DataError: {late}" in output and "Traceback" not in output
    assert [steps(run) for run in do.runs("mixed")] == [8]
    write_toy_object(late, frames=8)
    status, output = do("mixed", *swept)
    assert status == 0 and "1 trained, 1 finished before" in output, output
    assert [steps(run) for run in do.runs("mixed")] == [8, 8]


@pytest.mark.slow
def test_a_job_that_failed_later_is_tried_again_on_demand(do: Sweeps) -> None:
    assert do("later", "seed=0", **dying(SAVED, 2))[0] == -9
    (run,) = do.runs("later")
    (run / "FAILED").write_text("ValueError: no\n")
    status, output = do("later", "seed=0")
    assert status == 2 and "left out, failed before" in output, output
    status, output = do("later", "seed=0", "retry_failed=true")
    assert status == 0 and "1 trained" in output and steps(run) == 8, output


def test_threads_are_shared_among_the_jobs_of_a_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    def threads(cores: int, *overrides: str) -> int:
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
        with hydra.initialize_config_dir(str(_conf.conf_dir()), version_base="1.3"):
            config = hydra.compose("train", ["hydra.mode=MULTIRUN", *overrides], return_hydra_config=True)
        monkeypatch.setattr(HydraConfig.instance(), "cfg", config)
        return config.render.threads

    joblib = "hydra/launcher=joblib"
    assert threads(2) == threads(64) == 2
    assert threads(2, joblib) == 1 and threads(64, joblib, "hydra.launcher.n_jobs=-2") == 1  # a core each
    assert threads(2, joblib, "hydra.launcher.n_jobs=2") == 1 and threads(8, joblib, "hydra.launcher.n_jobs=4") == 2
    assert threads(2, joblib, "hydra.launcher.n_jobs=8") == 1
    assert threads(64, "hydra/launcher=submitit_slurm") == 1
    assert threads(64, "hydra/launcher=submitit_slurm", "hydra.launcher.cpus_per_task=8") == 2
    assert threads(2, joblib, "render.threads=5") == 5


def learned(run: Path) -> str:
    return digest(read_checkpoint(run / "last.ckpt")["state_dict"])


@pytest.mark.slow
@pytest.mark.parametrize("launcher", [("hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
                                      ("hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=1")])  # fmt: skip
def test_jobs_side_by_side_leave_what_one_after_another_would(do: Sweeps, launcher: tuple[str, str]) -> None:
    name = launcher[0].split("=")[1]
    assert do("in_turn", "seed=0,1")[0] == 0
    status, output = do(name, "seed=0,1", *launcher)
    assert status == 0 and "sweep of 2 jobs: 2 trained" in output, output
    status, output = do(name, "seed=0,1,2", *launcher)
    assert status == 0 and "sweep of 3 jobs: 1 trained, 2 finished before" in output, output
    assert [history(run) for run in do.runs(name)] == 3 * [["started", "finished"]]
    assert [learned(run) for run in do.runs(name)[:2]] == [learned(run) for run in do.runs("in_turn")]


@pytest.mark.slow
def test_a_sweep_of_six_killed_five_times_completes_every_run_once(do: Sweeps) -> None:
    swept = ("seed=0,1,2,3,4,5", "plan.repeats=5", "plan.epochs=6")
    status, output = do("undisturbed", *swept)
    assert status == 0, output
    # Moments are counted in calls, not in seconds: 360 steps in all, saved once to seven times an epoch.
    moments, told = random.Random(1), Counter[str]()
    deaths = [(STEP, moments.randint(60, 100)), (SAVED, moments.randint(5, 40)), (FINISH, 1),
              (STEP, moments.randint(60, 100)), ("os.replace", moments.randint(20, 80))]  # fmt: skip
    for target, count in deaths:
        every = f"trainer.checkpoint_steps={moments.choice((1, 3, 7))}"
        status, output = do("disturbed", *swept, every, **dying(target, count))
        assert status == -9, f"ended by itself ({status}) before {target} was called {count} times\n{output}"
        told.update(line for line in output.splitlines() if line.startswith("run: "))
    status, output = do("disturbed", *swept)
    assert status == 0 and "finished before" in output, output
    told.update(line for line in output.splitlines() if line.startswith("run: "))
    runs = do.runs("disturbed")
    assert told == Counter(f"run: {run.as_uri()}" for run in runs) and len(runs) == 6  # each came to its end once
    resumed = 0
    for run, whole in zip(runs, do.runs("undisturbed"), strict=True):
        events = history(run)
        assert events.count("finished") == 1 and events[-1] == "finished"
        assert steps(run) == steps(whole) == 60 and learned(run) == learned(whole)
        resumed += events.count("resumed")
    assert resumed >= 3
