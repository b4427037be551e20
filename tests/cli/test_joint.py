"""Several objects with one network; what a new object takes over from it, and new sequences of one (`gausim adapt`)."""

from pathlib import Path

import pytest
import torch
from helpers.joint_runs import TINY, both, weights
from helpers.toy_object import ToyObject, toy_scene, write_object
from helpers.toy_runs import rows
from torch import Tensor

from gausim.cli import adapt, evaluate, simulate
from gausim.cli import train as command
from gausim.compose.build import load_run
from gausim.compose.data_paths import data_option, located
from gausim.core import ConfigError, DataError, RunError
from gausim.results.table import load_results
from gausim.training.callbacks.resume import RunCheckpoint

NETWORK = "model.predictor.network."


def tune(root: Path, source: Path, out: Path, *arguments: str) -> dict[str, Tensor]:
    asked = ["data=object", f"data.root={root}", f"init_from={source}", f"hydra.run.dir={out}/seed_0"]
    assert command.main([*asked, *TINY, "evaluate=false", *arguments]) == 0
    return weights(out / "seed_0")


def test_objects_of_different_stores_share_the_network_and_nothing_else(joint: Path, tmp_path: Path) -> None:
    run = load_run(joint)
    assert [(o.name, o.fps, len(o.sequences), len(o.train_views)) for o in run.objects] == [
        ("toy", 24.0, 2, 2), ("other", 50.0, 3, 2),
    ]  # fmt: skip
    simulator, states = run.module.model, run.module.initial_states
    assert [tuple(p.shape) for p in simulator.attributes] == [(36, 8), (63, 8)]
    assert simulator.fps == (24.0, 50.0) and len(simulator.template.bodies) == 2
    assert len(list(states.parameters())) == 5 and states.scene_of_sequence == (0, 0, 1, 1, 1)
    for own in (*simulator.log_density, *simulator.attributes, *states.parameters()):
        assert bool(own.detach().any())  # each has learned
    assert [o.sequences[0].cameras.width for o in run.objects] == [32, 24]
    assert [int(s.pinned.sum()) for s in simulator.scenes] == [9, 9]  # the second store's own selection, 15 without
    assert evaluate.main([str(joint), "--cameras", "train", "--out", str(tmp_path)]) == 0
    results = load_results(tmp_path / "metrics.json")
    assert {name: o.splits["seen"] for name, o in results.objects.items()} == {"toy": (0, 8), "other": (0, 6)}
    errors = [e.value for e in results.table if (e.row, e.split, e.metric) == ("gausim", "seen", "l2")]
    assert errors[0] != errors[1] and min(errors) > 0


def test_a_frozen_network_stays_bit_by_bit_and_a_free_one_learns(joint, other, tmp_path, capsys) -> None:
    source = weights(joint)
    shared = [name for name in source if name.startswith("model.predictor.")]
    assert {name.split(".")[2] for name in shared} == {"network", "node_normaliser", "edge_normaliser"}
    frozen = tune(other, joint, tmp_path / "frozen", "freeze=network")
    free = tune(other, joint, tmp_path / "free")
    assert "other values of" not in capsys.readouterr().out
    assert all(torch.equal(frozen[name], source[name]) for name in shared)
    assert any(not torch.equal(free[name], source[name]) for name in shared if name.startswith(NETWORK))
    assert float(free["model.predictor.node_normaliser.count"]) > float(source["model.predictor.node_normaliser.count"])
    prefixes = ("model.attributes", "model.log_density", "initial_states.velocity")
    own = [name for name in frozen if name.startswith(prefixes)]
    assert len(own) == 2 + 3 and all(bool(frozen[name].any()) for name in own)  # of one scene and its three sequences


@pytest.mark.slow
def test_a_network_that_was_taken_over_is_trained_on_after_a_cut(joint, other, tmp_path, monkeypatch) -> None:
    saved = RunCheckpoint.on_train_epoch_end

    def crash(self: RunCheckpoint, trainer: object, pl_module: object) -> None:
        saved(self, trainer, pl_module)  # type: ignore[arg-type]
        raise MemoryError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(RunCheckpoint, "on_train_epoch_end", crash)
        with pytest.raises(MemoryError):
            tune(other, joint, tmp_path / "cut")
    resumed, free = (tune(other, joint, tmp_path / name) for name in ("cut", "free"))
    assert all(torch.equal(value, free[name]) for name, value in resumed.items())


@pytest.mark.slow
def test_the_papers_model_hands_on_its_network_too(toy: Path, other: Path, tmp_path: Path) -> None:
    run, model = tmp_path / "joint" / "seed_0", "model=gausim_paper"
    asked = ["data=joint", both(toy, other), model, "plan.batch_size=3", f"hydra.run.dir={run}"]
    assert command.main([*asked, *TINY]) == 0
    frozen, source = tune(other, run, tmp_path / "frozen", model, "freeze=network"), weights(run)
    shared = [name for name in source if name.startswith("model.predictor.")]
    assert shared and all(torch.equal(frozen[name], source[name]) for name in shared)


def test_a_network_of_other_settings_is_named_and_of_another_shape_refused(joint, other, tmp_path, capsys) -> None:
    tune(other, joint, tmp_path / "centred", "model.simulator.features.centred=false")
    assert "was trained with other values of model.simulator.features.centred\n" in capsys.readouterr().out
    message = (
        r"init_from: the network of .*last\.ckpt does not fit this model: predictor\.network\.decoder\.0\.bias is "
        r"of shape \(4,\) there, of shape \(8,\) here.*config\.yaml has it; what differs: "
        r"model\.simulator\.network\.hidden\."
    )
    with pytest.raises(ConfigError, match=message):
        tune(other, joint, tmp_path / "wide", "model.simulator.network.hidden=16")
    assert not (tmp_path / "wide" / "seed_0" / "last.ckpt").exists()
    with pytest.raises(ConfigError, match=r"network\.processor\.1\.\w+\.\w+ is absent there, of shape"):
        tune(other, joint, tmp_path / "deep", "model.simulator.network.layers=2")


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
    quick = ["--epochs", "4", "--set", "optimizer.initial_lr=0.015"]
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
