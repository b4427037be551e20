"""`gausim adapt`: initial states of new sequences, everything else bit by bit as the run has it."""

from __future__ import annotations

import csv
import json
import runpy
from pathlib import Path

import pytest
import torch
from helpers import toy_object
from torch import Tensor

from gausim.cli import adapt
from gausim.cli import train as command
from gausim.cli.simulate import command as simulate
from gausim.compose.build import load_run
from gausim.core import ConfigError, DataError, RunError
from gausim.runs.checkpoint import read_checkpoint

JOINT = runpy.run_path(str(Path(__file__).parent / "test_joint.py"))
TINY = JOINT["TINY"]


@pytest.fixture(scope="module")
def stores(toy: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return toy, JOINT["other_object"](tmp_path_factory.mktemp("stores") / "two")


@pytest.fixture(scope="module")
def trained(stores: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of both objects, the second pinned by its own selection."""
    run = tmp_path_factory.mktemp("joint") / "seed_0"
    roots = f'data.root=[{stores[0]},{{root: {stores[1]}, selections: {{pinned: "z=0.05"}}}}]'
    asked = ["data=joint", roots, "data.batch_size=3", "trainer.max_epochs=2", f"hydra.run.dir={run}"]
    assert command.main([*TINY, *asked, "optimizer.ema_decay=0.5"]) == 0
    return run


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy under pushes that the run has not seen."""
    root = tmp_path_factory.mktemp("new") / "toy"
    amplitudes = {"hard": 0.5, "soft": 0.1, "other_way": -0.4}
    return toy_object.write_object(
        toy_object.ToyObject(root, toy_object.toy_scene(), amplitudes=amplitudes, frames=10)
    ).root


def weights(run: Path) -> dict[str, Tensor]:
    return read_checkpoint(run / "last.ckpt")["state_dict"]


def ratios(run: Path) -> list[float]:
    with (run / "epochs.csv").open() as file:
        return [float(row["ratio_static"]) for row in csv.DictReader(file)]


@pytest.mark.usefixtures("evaluated_here")
def test_only_initial_states_are_learned_and_the_result_is_a_run(trained: Path, pushed: Path, tmp_path: Path) -> None:
    out = tmp_path / "adapted"
    asked = [str(trained), "--data", str(pushed), "--sequences", "hard", "other_way", "--frames", "4"]
    assert adapt.main([*asked, "--out", str(out), "--epochs", "4"]) == 0
    found, source = weights(out), load_run(trained).module.model.state_dict()
    own = {name.removeprefix("model."): value for name, value in found.items() if name.startswith("model.")}
    of_toy = {
        n: v for n, v in source.items() if not n.startswith(("log_density.1", "attributes.1", "template.scenes.1"))
    }
    assert set(own) == set(of_toy)
    for name, value in own.items():  # the averaged weights of the run, statistics included
        assert torch.equal(value, of_toy[name]), name
    states = [value for name, value in found.items() if name.startswith("initial_states.")]
    assert len(states) == 2 and all(bool(value.any()) for value in states)
    run = load_run(out)
    assert [r.name for r in run.objects[0].sequences] == ["hard", "other_way"]
    assert run.config["data"]["curriculum"]["t_max"] == 3 and run.config["name"].endswith("_adapted_4")
    assert ratios(out)[-1] < 0.9 * ratios(out)[0]
    rows = json.loads((out / "evaluation" / "metrics.json").read_text())["objects"]["toy"]["rows"]
    assert rows["gausim"]["seen"]["train"]["l2"]["mean"] > 0
    assert simulate.main([str(out), "--out", str(tmp_path / "videos"), "--frames", "2"]) == 0


def test_the_second_scene_of_a_joint_run_keeps_its_own_weights(
    trained: Path, stores: tuple[Path, Path], tmp_path: Path
) -> None:
    out = tmp_path / "adapted"
    asked = ["--data", str(stores[1]), "--sequences", "c", "--epochs", "1", "--frames", "3", "--out", str(out)]
    assert adapt.main([str(trained), *asked, "--set", "evaluate=false", "optimizer.initial_lr=0.01"]) == 0
    found, source = weights(out), load_run(trained).module.model.state_dict()
    for name in ("log_density", "attributes", "template.scenes"):
        mine = {k: v for k, v in found.items() if k.startswith(f"model.{name}.")}
        assert mine and all(k.startswith(f"model.{name}.0") for k in mine)
        for key, value in mine.items():
            assert torch.equal(value, source[key.removeprefix("model.").replace(f"{name}.0", f"{name}.1", 1)]), key
    run = load_run(out)
    assert run.config["optimizer"]["initial_lr"] == 0.01
    assert int(run.module.model.scenes[0].pinned.sum()) == 9  # the run's selection, though the store has another mask


def test_without_a_store_the_runs_own_data_and_default_place(trained: Path) -> None:
    assert adapt.main([str(trained), "--epochs", "1", "--frames", "2", "--set", "evaluate=false"]) == 0
    out = trained.parent.with_name(f"{trained.parent.name}_adapted_2") / "seed_0"
    assert [o.name for o in load_run(out).objects] == ["toy", "other"]
    with pytest.raises(RunError, match="finished"):
        adapt.main([str(trained), "--epochs", "1", "--frames", "2", "--set", "evaluate=false"])


def test_what_does_not_fit_is_named(trained: Path, pushed: Path, tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "out"), "--epochs", "1"]
    with pytest.raises(ConfigError, match=r"--frames: expected at least 2"):
        adapt.main([str(trained), "--frames", "1", *out])
    with pytest.raises(ConfigError, match=r"t_max"):
        adapt.main([str(trained), "--frames", "9", *out])  # the object's training frames are 0..7
    with pytest.raises(ConfigError, match=r"--set trainer\.thread=1.*thread"):
        adapt.main([str(trained), "--frames", "3", *out, "--set", "trainer.thread=1"])
    with pytest.raises(ConfigError, match=r"--set threads: expected KEY=VALUE"):
        adapt.main([str(trained), "--frames", "3", *out, "--set", "threads"])
    with pytest.raises(DataError, match=r"sequences \['none'\]"):
        adapt.main([str(trained), "--frames", "3", "--data", str(pushed), "--sequences", "none", *out])
    with pytest.raises(RunError, match="no run here"):
        adapt.main([str(tmp_path / "nowhere"), *out])
    toy_object.write_object(toy_object.ToyObject(tmp_path / "strange", toy_object.toy_scene(), amplitudes={"a": 0.1}))
    path = tmp_path / "strange" / "dataset.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "name": "stranger"}))
    with pytest.raises(
        DataError, match=r"holds \['stranger'\], which the run does not know; it knows \['toy', 'other'\]"
    ):
        adapt.main([str(trained), "--frames", "3", "--data", str(tmp_path / "strange"), *out])
