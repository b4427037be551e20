"""Several objects of different stores with one network, and what a new object takes over from it."""

from pathlib import Path

import pytest
import torch
from helpers.joint_runs import TINY, both, weights
from torch import Tensor

from gausim.cli import evaluate
from gausim.cli import train as command
from gausim.compose.build import load_run
from gausim.core import ConfigError
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
