"""`gausim adapt`: initial states of new sequences, everything else bit by bit as the run has it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.joint_runs import weights
from helpers.toy_object import ToyObject, toy_scene, write_object
from helpers.toy_runs import rows

from gausim.cli import adapt, simulate
from gausim.compose.build import load_run
from gausim.compose.data_paths import data_option, located
from gausim.core import ConfigError, DataError, RunError
from gausim.results.table import load_results


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy under pushes that the run has not seen."""
    amplitudes = {"hard": 0.5, "soft": 0.1, "other_way": -0.4}
    root = tmp_path_factory.mktemp("new") / "toy"
    return write_object(ToyObject(root, toy_scene(), amplitudes=amplitudes, frames=10)).root


@pytest.mark.usefixtures("evaluated_here")
def test_only_initial_states_are_learned_and_the_result_is_a_run(joint: Path, pushed: Path, tmp_path: Path) -> None:
    out = tmp_path / "adapted"
    asked = [str(joint), "--data", str(pushed), "--sequences", "hard", "other_way", "--frames", "4"]
    quick = ["--epochs", "6", "--set", "optimizer.initial_lr=0.01"]
    assert adapt.main([*asked, "--out", str(out), *quick]) == 0
    found, source = weights(out), load_run(joint).module.model.state_dict()
    own = {name.removeprefix("model."): value for name, value in found.items() if name.startswith("model.")}
    second = ("log_density.1", "attributes.1")
    assert set(own) == {name for name in source if not name.startswith(second)}
    assert all(torch.equal(value, source[name]) for name, value in own.items())  # statistics included
    states = [value for name, value in found.items() if name.startswith("initial_states.velocity")]
    assert len(states) == 2 and all(bool(value.any()) for value in states)
    run = load_run(out)
    assert [r.name for r in run.objects[0].sequences] == ["hard", "other_way"]
    assert run.config["plan"]["t_max"] == 3 and run.config["name"].endswith("_adapted_4")
    ratios = [float(row["ratio_static"]) for row in rows(out / "epochs.csv")]
    assert ratios[-1] < 0.9 * ratios[0]
    told = load_results(out / "evaluation" / "metrics.json").table
    assert next(e.value for e in told if (e.row, e.split, e.metric) == ("gausim", "seen", "l2")) > 0
    videos = ["--out", str(tmp_path / "videos"), "--frames", "2", "--cameras", "cam_0"]
    assert simulate.main([str(out), *videos]) == 0


@pytest.mark.slow
def test_the_second_scene_of_a_joint_run_keeps_its_own_weights(joint: Path, other: Path, tmp_path: Path) -> None:
    out = tmp_path / "adapted"
    asked = ["--data", str(other), "--sequences", "c", "--epochs", "1", "--frames", "3", "--out", str(out)]
    assert adapt.main([str(joint), *asked, "--set", "evaluate=false", "optimizer.initial_lr=0.01"]) == 0
    found, source = weights(out), load_run(joint).module.model.state_dict()
    for name in ("log_density", "attributes"):
        mine = {k: v for k, v in found.items() if k.startswith(f"model.{name}.")}
        assert mine and all(k.startswith(f"model.{name}.0") for k in mine)
        for key, value in mine.items():
            assert torch.equal(value, source[key.removeprefix("model.").replace(f"{name}.0", f"{name}.1", 1)]), key
    run = load_run(out)
    assert run.config["optimizer"]["initial_lr"] == 0.01
    assert int(run.module.model.scenes[0].pinned.sum()) == 9  # the run's selection, though the store has another mask


def test_without_a_store_the_runs_own_data_and_default_place(joint: Path) -> None:
    asked = [str(joint), "--epochs", "1", "--frames", "2", "--set", "evaluate=false", "doctor=true"]
    assert adapt.main(asked) == 0
    out = joint.parent.with_name(f"{joint.parent.name}_adapted_2") / joint.name
    assert [o.name for o in load_run(out).objects] == ["toy", "other"]
    with pytest.raises(RunError, match="finished"):
        adapt.main(asked)


@pytest.mark.parametrize(("asked", "error", "message"), [
    (["--frames", "1"], ConfigError, "--frames: expected at least 2"),
    (["--frames", "9"], ConfigError, "t_max"),  # the object's training frames are 0..7
    (["--set", "trainer.thread=1"], ConfigError, r"--set trainer\.thread=1.*thread"),
    (["--data", "PUSHED", "--sequences", "none"], DataError, r"sequences \['none'\]"),
    (["--data", "STRANGE"], DataError, r"holds \['stranger'\], which .* not know; it knows \['toy', 'other'\]"),
])  # fmt: skip
def test_what_does_not_fit_is_named(joint, pushed, tmp_path, asked, error, message) -> None:
    strange = tmp_path / "strange"
    strange.mkdir()
    (strange / "dataset.json").write_text((pushed / "dataset.json").read_text().replace('"toy"', '"stranger"'))
    (strange / "sequences").symlink_to(pushed / "sequences")
    words = [{"PUSHED": str(pushed), "STRANGE": str(strange)}.get(word, word) for word in asked]
    with pytest.raises(error, match=message):
        adapt.main([str(joint), "--frames", "3", "--epochs", "1", "--out", str(tmp_path / "out"), *words])


def test_data_words_become_keys_and_entries_keep_what_else_they_say(tmp_path: Path) -> None:
    assert data_option([]) == {}
    assert data_option(["a"]) == {"root": "a"}
    assert data_option(["a", "root=b=c", "scene=s.ply"]) == {"root": ["a", "b=c"], "scene": "s.ply"}
    assert data_option(["odd=name"]) == {"root": "odd=name"}
    with pytest.raises(ConfigError, match="--data masks=b: masks is given twice"):
        data_option(["masks=a", "masks=b"])
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    own = {"root": ["/gone", {"root": "/gone/too", "selections": {"pinned": "z=0.1"}}], "names": ["x"]}
    found = located(tmp_path, own, data_option([str(tmp_path / "a"), str(tmp_path / "b")]))
    assert found["root"] == [str(tmp_path / "a"), {"root": str(tmp_path / "b"), "selections": {"pinned": "z=0.1"}}]
    assert found["names"] == ["x"]
    with pytest.raises(DataError, match="field data.root names /gone/too"):
        located(tmp_path, {"root": [str(tmp_path / "a"), own["root"][1]]}, {})
    (tmp_path / "set").mkdir()
    entry = {"root": str(tmp_path / "set"), "scene": "/gone/bunny.ply"}
    own = {"root": [entry], "scene": None, "masks": None}
    with pytest.raises(DataError, match=r"field data.root\[0\].scene names /gone/bunny.ply, expected a file"):
        located(tmp_path, own, {})
