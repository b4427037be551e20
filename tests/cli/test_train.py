import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.joint_runs import PAPER, weights
from helpers.shared import Shared
from helpers.simulators import LEVELS
from helpers.toy_object import toy_scene, write_toy_object
from helpers.toy_runs import rows

from gausim.cli import evaluate, training_run
from gausim.cli import train as command
from gausim.compose.build import load_run
from gausim.core import ConfigError, RunError
from gausim.io.ply import save_scene
from gausim.results.table import load_results
from gausim.runs.checkpoint import read_checkpoint

RUN = Path("outputs/toy/seed_0")


@pytest.fixture
def arguments(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(tmp_path)
    return [f"data.root={toy}", *PAPER]


@pytest.fixture(scope="session")
def finished(toy: Path, shared: Shared) -> Path:
    """A run of one epoch, which tests copy."""

    def train(root: Path) -> None:
        assert command.main([f"data.root={toy}", *PAPER, "plan.epochs=1", f"output_root={root}"]) == 0

    return shared("finished", train)


@pytest.fixture
def again(arguments: list[str], finished: Path, tmp_path: Path) -> list[str]:
    """The arguments of a run that is finished here already."""
    shutil.copytree(finished, tmp_path / "outputs")
    return [*arguments, "plan.epochs=1"]


def test_motion_and_data_are_looked_at_and_training_does_not_notice(arguments, capsys) -> None:
    shown = ["trainer.motion_epochs=1", "logger=default", "doctor=true", "trainer.panel_epochs=1"]
    assert command.main([*[x for x in arguments if x not in ("logger=none", "trainer.panel_epochs=0")], *shown]) == 0
    made = {"config.yaml", "FINISHED", "last.ckpt", "epochs.csv", "motion.csv", "panels", "tensorboard", "csv"}
    assert made <= {p.name for p in RUN.iterdir()}
    assert [(r["epoch"], float(r["steps"])) for r in rows(RUN / "epochs.csv")] == [("1", 1.0), ("2", 2.0)]
    assert [p.name for p in sorted((RUN / "panels").iterdir())] == ["step_000001", "step_000002"]
    told = capsys.readouterr().out
    assert "36 kernels" in told and "warning: in 2 uses of a sequence at optimizer.initial_lr=" in told
    assert "WARNING  extent" in told and "frames of each sequence only" in told and "NOTE" not in told
    result, address, *following = told.splitlines()[-4:]
    assert result.startswith("Trained for 2 epochs (") and "% of the static prediction's" in result
    assert address == f"run: {RUN.resolve().as_uri()}"
    assert [line.split("gausim ")[1].split()[0] for line in following] == ["evaluate", "report"]
    loaded = load_run(RUN)
    assert not loaded.module.training and loaded.objects[0].name == "toy"

    assert command.main([*arguments, "name=alone", "trainer.motion_epochs=0"]) == 0
    assert "WARNING" not in capsys.readouterr().out and not Path("outputs/alone/seed_0/motion.csv").exists()
    alone = weights(Path("outputs/alone/seed_0"))
    assert all(torch.equal(value, alone[name]) for name, value in weights(RUN).items())

    watched = rows(RUN / "motion.csv")
    assert [(r["epoch"], r["object"]) for r in watched] == [(epoch, "toy") for epoch in "012"]
    spent = [float(row["cpu_seconds"]) for row in watched]
    assert 0 < spent[0] < spent[1] < spent[2]
    assert evaluate.main([str(RUN)]) == 0
    table = load_results(RUN / "evaluation" / "metrics.json").table
    found = {(e.split, e.metric): e.value for e in table if (e.row, e.views) == ("gausim_paper", "points")}
    assert float(watched[-1]["error_unseen"]) == pytest.approx(found["unseen", "error_3d_ratio"], rel=1e-3)


def test_a_time_limit_that_the_start_spends_is_named() -> None:
    facts = {"epochs": 1, "optimizer_steps": 1, "last_epoch": {}}
    sentences = training_run._result(facts, {"max_minutes": 0.5, "epochs": 30})
    assert sentences == [
        "Trained for 1 epoch (1 step).",
        "Most of plan.max_minutes=0.5 went into the start. Raise this limit.",
    ]
    for plan in ({"max_minutes": None, "epochs": 30}, {"max_minutes": 0.5, "epochs": 1}):
        assert training_run._result(facts, plan) == sentences[:1]


def test_a_finished_run_is_refused_and_can_be_overwritten(again: list[str]) -> None:
    with pytest.raises(RunError, match=r"finished.*name=NAME.*overwrite=true"):
        command.main(again)
    assert command.main([*again, "overwrite=true"]) == 0


def test_a_wrong_key_and_a_sweep_without_m_are_refused(arguments: list[str], capsys) -> None:
    with pytest.raises(ConfigError, match="modle"):
        command.main([*arguments, "modle=gausim"])
    assert not Path("outputs").exists()
    assert command.main(["--help"]) == 0
    assert "usage: gausim train" in capsys.readouterr().out
    with pytest.raises(ConfigError, match=r"experiment=tables/ablations: is several trainings, so add -m"):
        command.main([*arguments, "experiment=tables/ablations"])


@pytest.mark.usefixtures("again")
def test_a_checkpoint_of_another_scene_is_refused(toy: Path, tmp_path: Path) -> None:
    other, scene = Path(shutil.copytree(toy, tmp_path / "other")), toy_scene()
    save_scene(replace(scene, means=scene.means * 1.01), other / "scene.ply")
    with pytest.raises(RunError, match=r"trained on 'toy' \(36 kernels.*but the data holds 'toy' \(36 kernels"):
        load_run(RUN, data={"root": str(other)})


def test_a_run_may_be_evaluated_when_it_is_trained(again: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[str]] = []
    status = [1]

    def run(command: list[str], *, env: dict[str, str]) -> object:
        calls.append(command[1:])
        assert env["OMP_NUM_THREADS"] == "1"
        return subprocess.CompletedProcess(command, status[0])

    monkeypatch.setattr(subprocess, "run", run)
    asked, made = [*again, "evaluate=true"], (RUN / "last.ckpt").stat().st_mtime_ns
    with pytest.raises(RunError, match=r"trained, but its evaluation failed with exit status 1.*same command"):
        command.main(asked)
    status[0] = 0
    assert command.main(asked) == 0  # the finished run is evaluated, not trained again and not refused
    assert (RUN / "last.ckpt").stat().st_mtime_ns == made
    assert [(call[0], call[2]) for call in calls] == [("-c", "evaluate")] * 2
    assert all(f"end_with({os.getpid()})" in call[1] for call in calls)  # it ends with this process
    (RUN / "evaluation").mkdir()
    (RUN / "evaluation" / "metrics.json").write_text("{}")
    for more in ([], ["loss.static_weight=2"]):
        with pytest.raises(RunError, match="finished"):
            command.main([*asked, *more])
    assert len(calls) == 2


@pytest.mark.slow  # compiles everything from nothing
def test_the_process_that_compiles_trains_to_the_same_bits_as_one_that_loads_from_the_cache(tmp_path: Path) -> None:
    toy = write_toy_object(tmp_path / "toy", frames=8).root
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "compiled"), "OMP_NUM_THREADS": "1"}
    states, compiled = [], []
    for run in ("first", "second"):
        command = [
            sys.executable, "-m", "gausim.cli.main", "train", f"data.root={toy}", "render=cpu", "trainer.threads=1",
            "trainer.accelerator=cpu", "plan.epochs=2", "trainer.progress=false", "plan.t_max=3",
            "plan.repeats=1", "plan.batch_size=2", LEVELS,
            "logger=none", f"hydra.run.dir={tmp_path / run}",
        ]  # fmt: skip
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        (checkpoint,) = tmp_path.glob(f"{run}/**/last.ckpt")
        states.append(read_checkpoint(checkpoint)["state_dict"])
        compiled.append({file: file.stat().st_mtime_ns for file in (tmp_path / "compiled").rglob("*.nbc")})
    assert compiled[0] and compiled[0] == compiled[1]
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())
