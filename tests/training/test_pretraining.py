"""Pretraining: known states and materials of a corpus, and the fit of a body of unknown material."""

import csv
import json
import math
import re
from pathlib import Path

import pytest
import scipy.linalg
import torch
from helpers.corpus import FRAMES, SEQUENCES, write_corpus
from msgspec.structs import replace

from benchmarks import bodies
from gausim.cli import evaluate, simulate, train
from gausim.compose.build import build
from gausim.compose.config import compose
from gausim.compose.unfilmed import open_scene
from gausim.core import ConfigError, GausSimError, SimState
from gausim.data.dataset import SampleKey
from gausim.data.pretraining import CorpusDataModule
from gausim.evaluation.corpus import BodyFigures, summary
from gausim.interaction.replay import replay as replay_session
from gausim.interaction.selections import Whole
from gausim.interaction.session import Force, Material
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.template.material import MaterialTemplate
from gausim.training.material_scan import DRAG, STIFFNESS, _coordinates, find_materials, known_motion
from gausim.training.module import GausSimModule
from gausim.training.rollout import States

SMALL = (
    "model.simulator.hierarchy.levels=[{diameter: 0.5, edge_length: 2.0}]", "model.simulator.template.modes=12",
    "model.simulator.template.solid.spacing=0.2", "model.simulator.network.hidden=8",
    "model.simulator.network.layers=1", "data.held_out=1", "plan.batch_size=2",
    "plan.t_start=2", "plan.t_max=4", "logger=none",
)  # fmt: skip


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_corpus(tmp_path_factory.mktemp("corpus"))


def pretraining(corpus: Path, *choice: str) -> tuple[GausSimModule, CorpusDataModule]:
    choice = choice or ("experiment=pretrain",)
    return build(compose([*choice, f"data.root={corpus}", *SMALL]))


def test_rollouts_begin_at_true_states_of_any_frame_and_spare_the_bodies_held_out(corpus: Path) -> None:
    module, data = pretraining(corpus)
    data.setup("fit")
    keys = [key for epoch in range(30) for batch in _batches(data, epoch) for key in batch]
    assert {key.sequence for key in keys} == set(range(2 * SEQUENCES))
    last = FRAMES - 2  # frame 0 of a sequence is the second one of the corpus
    assert {key.start for key in keys if key.steps == 4} == set(range(last - 4 + 1))

    sample = data.index[SampleKey(1, 4, 7)]
    state = module.method.initial([sample], module.model.batch((0,)))
    truth = data.objects[0].body.positions[1]
    assert torch.equal(state.positions, truth[8]) and torch.equal(state.previous, truth[7])
    identity = torch.eye(3).expand(4, 100, 3, 3)
    states = States(truth[9:13], identity, identity)
    compared, _ = module.supervision.comparison([sample], module.model.batch((0,)))(states, 0)
    assert compared.max() < 1e-9


def _batches(data, epoch: int):
    sampler = data.train_dataloader().batch_sampler
    sampler.set_epoch(epoch)
    return list(sampler)


def test_the_known_material_gives_the_body_its_lowest_period(corpus: Path) -> None:
    module, data = pretraining(corpus)
    model = module.model
    assert isinstance(model.template, MaterialTemplate)
    for scene_id, item in enumerate(data.objects):
        attributes = model.attributes[scene_id].detach()
        kernels, unit = model.hierarchies[scene_id].kernels, model.hierarchies[scene_id].ancestor(0, 1)
        assert torch.allclose(attributes[:, 0].diff(), item.body.stiffness[kernels].log().diff(), atol=1e-5)
        count = int(unit.max()) + 1
        own, density = (
            torch.stack([values[unit == i].mean(0) for i in range(count)])
            for values in (attributes, model.log_density[scene_id].detach().exp())
        )
        found = model.template.matrices(scene_id, density.log(), own, 1 / item.fps)
        stiffness, inertia = (x.detach().double().numpy() for x in (found.stiffness, found.inertia))
        lowest = scipy.linalg.eigh(stiffness, inertia, eigvals_only=True)[0]
        assert 2 * math.pi / math.sqrt(lowest) == pytest.approx(item.body.record.period, rel=1e-3)


COMMON = ("plan.epochs=2", "trainer.progress=false", *SMALL)


@pytest.fixture(scope="module")
def base(corpus: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("pretrained") / "base"
    assert train.main(["experiment=pretrain", f"data.root={corpus}", f"hydra.run.dir={run}", *COMMON]) == 0
    return run


def test_a_scene_that_was_never_filmed_swings_as_its_stiffness_says(corpus: Path, base: Path) -> None:
    _, data = pretraining(corpus)
    body = data.objects[0].scene()
    periods = {}
    for stiffness in (1.0, 4.0):
        live = open_scene(body, fps=24.0, base=base, stiffness=stiffness, damping=0.1, sway=0.02)
        tip = [float(live.step().positions[8, 0]) for _ in range(25 // int(stiffness**0.5))]
        periods[stiffness] = 4 * (1 + tip.index(max(tip)))  # frames to the first turn
    assert periods[1.0] == pytest.approx(24, abs=6) and periods[4.0] == pytest.approx(12, abs=3)

    live = open_scene(body, fps=24.0, base=base, sway=0.02)
    live.act(Force(Whole(), (1.0, 0.0, 0.0), 0.02))
    amplitudes = {}
    for stiffness in (1.0, 0.25, 4.0):
        live.act(Material(stiffness, damping=10.0))
        amplitudes[stiffness] = float([live.step() for _ in range(48)][-1].positions[8, 0] - body.means[8, 0])
    assert amplitudes[0.25] == pytest.approx(4 * amplitudes[1.0], rel=0.2)  # bends as a spring does
    assert amplitudes[4.0] == pytest.approx(amplitudes[1.0] / 4, rel=0.2)
    last = live.frame.positions
    again = open_scene(body, fps=24.0, base=base, sway=0.02)
    assert torch.equal(replay_session(again, live.session()).positions[-1], last)
    assert torch.equal(replay_session(live, live.session()).positions[-1], last)  # which begins with the first material
    alone = [open_scene(body, fps=24.0, stiffness=given, sway=0.02) for given in (None, 4.0)]
    assert not torch.equal(*(live.step().positions for live in alone))  # the template without a network has one, too
    with pytest.raises(ConfigError, match="--stiffness -1: expected a number > 0"):
        open_scene(body, fps=24.0, base=base, stiffness=-1.0)


def test_a_pretrained_network_is_fitted_to_bodies_held_out(corpus: Path, base: Path, tmp_path: Path, capsys) -> None:
    fit, common = tmp_path / "fit", [f"data.root={corpus}", *COMMON]
    assert {row["object"] for row in csv.DictReader((base / "motion.csv").open())} == {"beam2"}
    asked = ["experiment=pretrain_fit", f"init_from={base}", f"hydra.run.dir={fit}", "data.seen=6"]
    assert train.main([*asked, *common]) == 0
    before, after = (torch.load(run / "last.ckpt", weights_only=True)["state_dict"] for run in (base, fit))
    shared = [name for name in before if ".predictor." in name or ".template." in name]
    assert shared and all(torch.equal(before[name], after[name]) for name in shared)
    assert after["model.attributes.0"].abs().max() > 0
    with pytest.raises(GausSimError, match="pretrained on a corpus"):
        simulate.main([str(base)])
    capsys.readouterr()
    assert evaluate.main([str(base)]) == 0 and "Rank correlation" not in capsys.readouterr().out  # it was given
    assert evaluate.main([str(fit)]) == 0
    assert "Rank correlation of fitted and true stiffness: " in capsys.readouterr().out
    (body,) = json.loads((fit / "evaluation" / "corpus.json").read_text())["bodies"]
    assert body["name"] == "beam2" and body["period"] == pytest.approx(14 / 24) and abs(body["within"]) <= 1
    assert bodies.main([str(tmp_path), str(tmp_path / "curve.png")]) == 0
    assert re.search(r"6 frames seen: \S+ with 2 bodies\n", capsys.readouterr().out)
    assert (tmp_path / "curve.png").stat().st_size > 1000
    with pytest.raises(GausSimError, match="no fit to bodies of a corpus"):
        bodies.main([str(corpus), str(tmp_path / "curve.png")])
    with pytest.raises(GausSimError, match="measured as a whole"):
        evaluate.main([str(fit), "--sequences", "seq_000"])


def test_a_fit_to_the_truth_has_no_error_and_keeps_the_order_of_stiffness() -> None:
    names, periods = ("error", "static", "energy"), (1.0, 0.5, 2.0, 0.25)
    values = {name: tuple(float(i + 1) for i in range(3 if name != "energy" else 2)) for name in names}
    found = [
        BodyFigures(f"b{i}", "split" if i % 2 else "smooth", **values, period=p, fitted_period=1.1 * p, within=0.5 * i)
        for i, p in enumerate(periods)
    ]
    whole = summary(found)
    assert whole.error == (1.0, 1.0, 1.0) and whole.energy == 0.5 and whole.stiffness == pytest.approx(1.0)
    assert whole.within == 1.0 and whole.within_smooth == 0.5
    assert summary([replace(x, fitted_period=-x.period) for x in found]).stiffness == pytest.approx(-1.0)


@pytest.mark.slow
def test_a_scan_finds_the_even_material_of_a_motion_from_its_seen_frames(corpus: Path) -> None:
    torch.manual_seed(0)
    module, data = pretraining(corpus, "experiment=pretrain_fit", "init_from=RUN", "data.seen=8")
    model, body = module.model, data.objects[0].body
    candidates = [float(STIFFNESS[8]), float(DRAG[5]) - model.template.log_drag]
    with torch.no_grad():  # a material that is nearest to these candidates, of both numbers
        model.attributes[0][:, :2] = torch.tensor(candidates) + torch.tensor([0.1, 0.2])
    moved = SceneDynamics(model, 0).rollout(SimState(body.positions[0, 1], body.positions[0, 0]), FRAMES - 2).positions
    body.positions[:] = torch.cat((body.positions[0, :1], moved))
    body.positions[:, 10:] = torch.nan  # beyond the seen frames
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gausim.training.material_scan.UPDATES", 0)
        find_materials(model, data)
    found = model.attributes[0]
    assert (found == found[0]).all() and not found[:, 2:].any()
    assert found[0, :2].tolist() == pytest.approx(candidates)
    z = _coordinates(model, 0, data.objects[0])
    motion = known_motion(z, torch.tensor([1]), z.shape[1] - 2)
    scanned = float(motion.error(model.modal_scene(0)))
    find_materials(model, data)  # a fit by descent comes nearer, and looks at no unseen frame either
    assert float(motion.error(model.modal_scene(0))) < 0.5 * scanned
    for epoch in range(3):
        assert max(key.start + key.steps for batch in _batches(data, epoch) for key in batch) <= 7
    assert len(data.index.ground_truth(0).positions) == 8


def test_a_pure_network_is_pretrained_on_single_steps_from_true_states(corpus: Path, tmp_path: Path) -> None:
    small = [word for word in SMALL if "template" not in word and "plan.t_" not in word]
    words = ["experiment=pretrain", "model=gausim_network", f"data.root={corpus}", *small, "plan.epochs=1"]
    steps = [
        "plan.t_start=1", "plan.t_max=1", "plan.repeats=1", "loss.rest_image_weight=0", "trainer.progress=false",
        "trainer.motion_epochs=0",
    ]  # fmt: skip
    module, data = build(compose([*words, *steps]))
    assert module.plan.teach is None and data.knows_material
    assert all(bool((own == 0).all()) for own in module.model.attributes)  # what it decodes is learned
    assert train.main([*words, *steps, f"hydra.run.dir={tmp_path / 'base'}"]) == 0
    checkpoint = torch.load(tmp_path / "base/last.ckpt", weights_only=True)["state_dict"]
    after = checkpoint["model.predictor.network.decoder.4.weight"]
    assert bool(torch.isfinite(after).all()) and float(after.abs().max()) > 0  # it started from zero
