"""Pretraining: known states and materials of a corpus, and the fit of a body of unknown material."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import torch
from helpers.corpus import FRAMES, SEQUENCES, write_corpus

from gausim.cli import evaluate, train
from gausim.compose.build import build
from gausim.compose.config import compose
from gausim.core import GausSimError
from gausim.data.dataset import SampleKey
from gausim.models.template.material import REFERENCE_FPS, MaterialTemplate

SMALL = (
    "model.simulator.hierarchy.levels=[{diameter: 0.5, edge_length: 2.0}]", "model.simulator.template.modes=12",
    "model.simulator.template.spacing=0.2", "model.simulator.network.hidden=8", "model.simulator.network.layers=1",
    "data.held_out=1", "data.batch_size=2", "data.curriculum.t_max=4", "logger=none",
)  # fmt: skip


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_corpus(tmp_path_factory.mktemp("corpus"))


def test_rollouts_begin_at_true_states_of_any_frame_and_spare_the_bodies_held_out(corpus: Path) -> None:
    module, data = build(compose("train", ["experiment=pretrain", f"data.root={corpus}", *SMALL]))
    data.setup("fit")
    keys = [key for epoch in range(30) for batch in _batches(data, epoch) for key in batch]
    assert {key.sequence for key in keys} == set(range(2 * SEQUENCES))
    last = FRAMES - 2  # frame 0 of a sequence is the second one of the corpus
    assert {key.start for key in keys if key.steps == 4} == set(range(last - 4 + 1))

    sample = data.index[SampleKey(1, 4, 7)]
    state = module.method.initial([sample], module.model.batch((0,)))
    truth = data.objects[0].body.positions[1]
    assert torch.equal(state.positions, truth[8]) and torch.equal(state.previous, truth[7])
    compared, _ = module.supervision.comparison([sample], module.model.batch((0,)))(_still(truth[9:13]), 0)
    assert compared.max() < 1e-9


def _batches(data, epoch: int):
    sampler = data.train_dataloader().batch_sampler
    sampler.set_epoch(epoch)
    return list(sampler)


def _still(positions: torch.Tensor):
    from gausim.training.rollout import States

    identity = torch.eye(3).expand(len(positions), 100, 3, 3)
    return States(positions, identity, identity)


def test_the_known_material_gives_the_body_its_lowest_period(corpus: Path) -> None:
    module, data = build(compose("train", ["experiment=pretrain", f"data.root={corpus}", *SMALL]))
    model = module.model
    assert isinstance(model.template, MaterialTemplate)
    for scene_id, item in enumerate(data.objects):
        attributes = model.attributes[scene_id].double().detach()
        kernels, unit = model.hierarchies[scene_id].kernels, model.hierarchies[scene_id].ancestor(0, 1)
        assert torch.allclose(attributes[:, 0].diff(), item.body.stiffness[kernels].log().diff().double(), atol=1e-5)
        count = int(unit.max()) + 1
        stiffness, density = (
            np.array([float(values[unit == i].mean()) for i in range(count)])
            for values in (attributes[:, 0], model.log_density[scene_id].exp())
        )
        body = model.template.body(scene_id)
        k = np.einsum("n,pnlm->lm", np.exp(stiffness), body.stiffness.double().numpy())
        m = np.einsum("nal,n,nam->lm", body.inertia, density, body.inertia)
        lowest = scipy.linalg.eigh(k, m, eigvals_only=True)[0] * math.exp(model.template.start[0])
        period = 2 * math.pi / math.sqrt(lowest) * item.fps / REFERENCE_FPS
        assert period == pytest.approx(item.body.record.period, rel=1e-3)


def test_a_pretrained_network_is_fitted_to_bodies_held_out(corpus: Path, tmp_path: Path, capsys) -> None:
    base, fit = tmp_path / "base", tmp_path / "fit"
    common = [f"data.root={corpus}", "trainer.max_epochs=2", "trainer.progress=false", *SMALL]
    assert train.main(["experiment=pretrain", f"hydra.run.dir={base}", *common]) == 0
    assert {row["object"] for row in csv.DictReader((base / "motion.csv").open())} == {"beam2"}
    assert (
        train.main(["experiment=pretrain_fit", f"init_from={base}", f"hydra.run.dir={fit}", "data.seen=6", *common])
        == 0
    )
    before, after = (torch.load(run / "last.ckpt", weights_only=True)["state_dict"] for run in (base, fit))
    shared = [name for name in before if ".predictor." in name or ".template." in name]
    assert shared and all(torch.equal(before[name], after[name]) for name in shared)
    assert after["model.attributes.0"].abs().max() > 0
    with pytest.raises(GausSimError, match="pretrained on a corpus"):
        evaluate.main([str(base)])
