"""Several objects of different stores with one network, and what a new object takes over from it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from helpers import toy_object
from helpers.simulators import LEVELS
from torch import Tensor

from gausim.cli import evaluate
from gausim.cli import train as command
from gausim.compose.build import load_run
from gausim.core import Cameras, ConfigError, GaussianScene, RunError
from gausim.runs.checkpoint import read_checkpoint

TINY = (
    "model.simulator.network.layers=1", "model.simulator.network.hidden=8", LEVELS,
    "data.curriculum.t_start=2", "data.curriculum.t_max=2", "data.repeats=1", "trainer.max_epochs=2",
    "trainer.accelerator=cpu", "trainer.progress=false", "trainer.threads=1", "render=reference",
    "callbacks.panels=null", "logger=none",
    "doctor=false",
)  # fmt: skip
SHARED = ("model.predictor.",)


def other_object(root: Path) -> Path:
    """An object of other kernels, frame rate, image size, cameras, frames and sequences than the toy's."""
    means = toy_object.toy_scene().means
    scene = GaussianScene.create(
        means=torch.cat((means * 2, means[9:] * 2 + 0.1)),
        log_scales=torch.full((63, 3), -1.6),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(63, 4).clone(),
        opacity_logits=torch.full((63,), 2.0),
        sh=torch.rand(63, 1, 3, generator=torch.Generator().manual_seed(1)),
        pinned=torch.cat((means, means[9:]))[:, 2] < 0.1,
        name="other",
    )
    seen = toy_object.cameras().select([0, 1])
    smaller = seen.Ks * torch.tensor([[0.75], [0.75], [1.0]])
    cameras = Cameras(seen.viewmats, smaller, 24, 20, ("left", "right"))
    amplitudes = {"a": 0.2, "b": 0.1, "c": -0.2}
    settings = {"frames": 12, "first_unseen": 6, "fps": 50.0, "amplitudes": amplitudes, "cameras": cameras}
    return toy_object.write_object(toy_object.ToyObject(root, scene, **settings)).root


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("stores")
    return toy_object.write_toy_object(folder / "one" / "toy").root.parent, other_object(folder / "two")


@pytest.fixture(scope="module")
def joint(stores: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A joint run of each model."""
    runs = {}
    for model in ("gausim", "gausim_paper"):
        runs[model] = tmp_path_factory.mktemp(model) / "seed_0"
        root = f'data.root=[{stores[0]},{{root: {stores[1]}, selections: {{pinned: "z=0.05"}}}}]'
        arguments = ["data=joint", root, "data.batch_size=3", f"model={model}", f"hydra.run.dir={runs[model]}"]
        assert command.main([*arguments, *TINY]) == 0
    return runs


def weights(run: Path) -> dict[str, Tensor]:
    return read_checkpoint(run / "last.ckpt")["state_dict"]


def tune(root: Path, source: Path, out: Path, *arguments: str) -> dict[str, Tensor]:
    name = source.parent.name.removesuffix("0")
    asked = [f"model={name}", f"data.root={root}", f"init_from={source}", f"hydra.run.dir={out}/seed_0"]
    assert command.main(["experiment=finetune", *asked, *TINY, "evaluate=false", *arguments]) == 0
    return weights(out / "seed_0")


def test_objects_of_different_stores_share_the_network_and_nothing_else(joint: dict[str, Path]) -> None:
    run = load_run(joint["gausim"])
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


def test_a_joint_run_is_evaluated_per_object(joint: dict[str, Path]) -> None:
    assert evaluate.main([str(joint["gausim_paper"]), "--views", "train"]) == 0
    path = joint["gausim_paper"] / "evaluation" / "partial" / "metrics.json"
    objects = json.loads(path.read_text())["objects"]
    assert list(objects) == ["toy", "other"]
    assert [o["splits"]["seen"] for o in objects.values()] == [[0, 8], [0, 6]]
    errors = [o["rows"]["gausim"]["seen"]["train"]["l2"]["mean"] for o in objects.values()]
    assert errors[0] != errors[1] and min(errors) > 0


@pytest.mark.parametrize("model", ["gausim", "gausim_paper"])
def test_a_frozen_network_stays_bit_by_bit_and_a_free_one_learns(
    joint: dict[str, Path], model: str, tmp_path: Path
) -> None:
    new, source = other_object(tmp_path / "new"), weights(joint[model])
    shared = [name for name in source if name.startswith(SHARED)]
    assert {name.split(".")[2] for name in shared} == {"network", "node_normaliser", "edge_normaliser"}
    start = tune(new, joint[model], tmp_path / "start", "optimizer.network_lr=0", "trainer.max_epochs=1")
    frozen = tune(new, joint[model], tmp_path / "frozen", "freeze=network")
    free = tune(new, joint[model], tmp_path / "free")
    for name in shared:
        assert torch.equal(frozen[name], source[name]), name
        if name.startswith("model.predictor.network."):
            assert torch.equal(start[name], source[name]), name
    assert any(not torch.equal(free[n], source[n]) for n in shared if n.startswith("model.predictor.network."))
    assert float(free["model.predictor.node_normaliser.count"]) > float(source["model.predictor.node_normaliser.count"])
    own = [name for name in frozen if name.startswith(("model.attributes", "model.log_density", "initial_states."))]
    assert len(own) == 2 + 3 and all(bool(frozen[name].any()) for name in own)  # of one scene and its three sequences


def test_a_resumed_run_keeps_its_own_network(
    joint: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gausim.training.callbacks.resume import RunCheckpoint

    new, saved = other_object(tmp_path / "new"), RunCheckpoint.on_train_epoch_end
    whole = tune(new, joint["gausim"], tmp_path / "whole")

    def crash(self: RunCheckpoint, trainer: object, pl_module: object) -> None:
        saved(self, trainer, pl_module)  # type: ignore[arg-type]
        raise MemoryError("power cut")

    with monkeypatch.context() as patch:
        patch.setattr(RunCheckpoint, "on_train_epoch_end", crash)
        with pytest.raises(MemoryError):
            tune(new, joint["gausim"], tmp_path / "cut")
    resumed = tune(new, joint["gausim"], tmp_path / "cut")
    assert all(torch.equal(value, whole[name]) for name, value in resumed.items())


def test_a_network_of_another_shape_is_refused_by_name(joint: dict[str, Path], tmp_path: Path) -> None:
    new = other_object(tmp_path / "new")
    message = (
        r"init_from: the network of .*last\.ckpt does not fit this model: predictor\.network\.decoder\.0\.bias is "
        r"of shape \(4,\) there, of shape \(8,\) here.*config\.yaml has it; what differs: "
        r"model\.simulator\.network\.hidden\."
    )
    with pytest.raises(ConfigError, match=message):
        tune(new, joint["gausim"], tmp_path / "wide", "model.simulator.network.hidden=16")
    assert not (tmp_path / "wide" / "seed_0" / "last.ckpt").exists()
    with pytest.raises(ConfigError, match=r"network\.processor\.1\.\w+\.\w+ is absent there, of shape"):
        tune(new, joint["gausim"], tmp_path / "deep", "model.simulator.network.layers=2")


def test_nothing_to_start_from_is_said(stores: tuple[Path, Path], tmp_path: Path) -> None:
    where = [f"data.root={stores[1]}", f"hydra.run.dir={tmp_path}/seed_0", *TINY]
    with pytest.raises(ConfigError, match=r"init_from: name the trained run.*init_from=RUN"):
        command.main(["experiment=finetune", *where])
    with pytest.raises(ConfigError, match=r"freeze: a network at random.*init_from=RUN"):
        command.main([*where, "freeze=network"])
    with pytest.raises(RunError, match=r"nowhere: no run here"):
        command.main([*where, f"init_from={tmp_path}/nowhere"])


def test_separate_asks_for_its_object(stores: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"data\.names: \[\] asked for, the roots hold \['toy', 'other'\]"):
        roots = f"data.root=[{stores[0]},{stores[1]}]"
        command.main(["experiment=separate", roots, f"hydra.run.dir={tmp_path}/seed_0", *TINY])
