"""Starts of a training, tracked motion and teaching: what is found, and that a resumed run keeps it."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from helpers.simulators import SMALLEST
from helpers.toy_object import ToyObject, toy_scene, write_object, write_toy_object
from helpers.toy_runs import rows

from gausim.cli import train
from gausim.compose.build import build
from gausim.compose.config import compose
from gausim.core import ConfigError
from gausim.models.template.modal import ModalScene
from gausim.runs.checkpoint import read_checkpoint
from gausim.training import modal_fit
from gausim.training.optimizers import OptimizerSettings
from gausim.training.plan import DataFacts, Teaching, TrainingPlan, WarmStart
from gausim.training.stages import begin
from gausim.training.teach import Lesson, oscillator_of
from gausim.training.tracking import Track, track
from gausim.training.warm_start import warm_start

QUICK = [x for x in SMALLEST if "warm_start" not in x] + [
    "render=cpu", "logger=none", "trainer.motion_epochs=0", "evaluate=false",
    "plan.t_max=4", "plan.repeats=1", "plan.batch_size=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_object(tmp_path_factory.mktemp("warm") / "toy", frames=8).root


MODES = "model.simulator.template.modes=6"
WARM = [MODES, "plan.warm_start.updates=30"]
CHOICES = [
    ["model=gausim", *WARM],
    pytest.param(["model=gausim", *WARM, "supervision=points"], marks=pytest.mark.slow),
    ["model=gausim_network", "plan.teach.shows=2", "plan.teach.rolls=2"],
]


@pytest.mark.parametrize("choice", CHOICES)
def test_a_resumed_run_starts_from_its_checkpoint_and_makes_no_start_again(toy, tmp_path, choice, capsys) -> None:
    common = [f"data.root={toy}", *choice, *QUICK, "plan.epochs=2"]
    assert train.main([*common, f"hydra.run.dir={tmp_path / 'whole'}"]) == 0
    printed = capsys.readouterr().out
    stated = yaml.safe_load((tmp_path / "whole/config.yaml").read_text())["plan"]
    if "model=gausim_network" in choice:
        assert all(f"  {stage}: " in printed for stage in ("track", "teach", "roll")) and "warm start" not in printed
        assert (stated["teach"]["shows"], stated["teach"]["rolls"], stated["warm_start"]) == (2, 2, None)
    else:
        assert "track: 2 sequences; of the 2 whose true motion is known" in printed and "warm start: " in printed
        assert float(rows(tmp_path / "whole/epochs.csv")[0]["excess_static"]) < 0.5  # 1 from rest
    cut = ["trainer.checkpoint_steps=1", f"hydra.run.dir={tmp_path / 'cut'}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gausim.training.module.GausSimModule.on_train_epoch_end", _interrupt)
        with pytest.raises(RuntimeError, match="cut"):
            train.main([*common, *cut])
    assert train.main([*common, *cut]) == 0
    resumed = capsys.readouterr().out.split("resuming")[1]
    assert "warm start" not in resumed and "  teach: " not in resumed
    whole, again = (read_checkpoint(tmp_path / n / "last.ckpt")["state_dict"] for n in ("whole", "cut"))
    assert all(torch.equal(value, again[name]) for name, value in whole.items())


def _interrupt(module: object) -> None:
    raise RuntimeError("cut")


def test_a_fit_in_modal_coordinates_finds_the_template_that_made_a_motion(
    toy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ModalScene, "solved", 1e-6)  # updates begin with the steps of the last one
    torch.manual_seed(0)
    module, _ = build(compose([f"data.root={toy}", "model=gausim", MODES, *QUICK]))
    model, draws = module.model, torch.Generator().manual_seed(3)
    start = 0.1 * torch.randn(2, 6, generator=draws)
    attributes = model.attributes[0].detach().clone()
    with torch.no_grad():
        model.attributes[0].copy_(0.5 * torch.randn(attributes.shape, generator=draws))
        part, z = model.modal_scene(0), [start, 1.2 * start]
        for _ in range(6):
            z.append(part.solve(z[-1], z[-2]).after)
        model.attributes[0].copy_(attributes)
    true = torch.stack(z)
    size = modal_fit.size_of(true.movedim(0, 1))

    def known(steps: int) -> modal_fit.KnownMotion:
        return modal_fit.KnownMotion(size, true[0], true[1], true[2 : 2 + steps])

    groups = {"scene": [model.attributes[0]]}
    settings = OptimizerSettings(scene_lr=0.1)
    losses = list(modal_fit.fit(model, [(0, known)], settings, groups, longest=6, updates=60))
    before = float(known(6).error(part))
    assert before == pytest.approx(0.0, abs=1e-4)
    assert losses[-1] < 0.02 * losses[0] and float(known(6).error(model.modal_scene(0))) < 0.1 * 6

    def astray(steps: int) -> modal_fit.KnownMotion:
        motion = known(steps)
        return motion if len(later) < 45 else replace(motion, after=5 * motion.after)

    later: list[float] = []
    for loss in modal_fit.fit(model, [(0, astray)], settings, groups, longest=6, updates=60):
        later.append(loss)
    distances = torch.stack([d.mean() for d in known(6).distances(model.modal_scene(0))])
    assert len(later) == 60 and later[-2] > 1 and later[-1] == min(later[30:])
    assert float(distances.mean()) == pytest.approx(later[-1], rel=1e-4)


@pytest.mark.parametrize("law", ["solid", "springs"])
@torch.no_grad()
def test_initial_states_are_found_in_the_motion_of_a_frozen_model(toy: Path, law: str) -> None:
    torch.manual_seed(0)
    module, _ = build(compose([f"data.root={toy}", "model=gausim", f"data.law={law}", MODES, *QUICK]))
    states, true = module.initial_states, 0.9 * torch.randn(2, 6)
    module.model.freeze(scenes=True)
    tracks = []
    for number, own in enumerate(true):
        states.parameter(number)[:6] = own
        moved = module.method.predict(number, 4).positions - module.model.scenes[0].means
        tracks.append(Track(0, number, moved))
        states.set_motion(number, moved[1])
    assert (states.parameter(0)[:6] - true[0]).norm() > 0.05 * true[0].norm()
    warm_start(module, tracks, WarmStart(), quiet=True)
    for number, own in enumerate(true):
        torch.testing.assert_close(states.parameter(number)[:6], own, rtol=0.02, atol=0.02)


def test_the_fit_has_the_settings_of_the_model_and_what_it_leaves_is_said(toy, tmp_path, monkeypatch, capsys) -> None:
    seen: list[int] = []

    def fit(model, motions, settings, groups, *, longest, updates, growing):
        assert growing == 0.25 and settings.decay["scene"] == 0.05  # of model=gausim
        seen.append(updates)
        yield 0.2

    monkeypatch.setattr(modal_fit, "fit", fit)
    common = [f"data.root={toy}", "model=gausim", MODES, *QUICK, "plan.epochs=1", "plan.warm_start.updates=60"]
    assert train.main([*common, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    assert seen == [60] and "without a network 0.200 of the motion is left" in capsys.readouterr().out


TAUGHT = ["model=gausim_network", *(word for word in QUICK if "t_max" not in word)]


@pytest.fixture(scope="module")
def long_toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    toy = ToyObject(tmp_path_factory.mktemp("teach") / "toy", toy_scene(), frames=28, first_unseen=16)
    return write_object(toy).root


def test_a_network_that_is_taught_an_oscillator_has_learned_its_flow(long_toy: Path) -> None:
    torch.manual_seed(0)
    options = ["supervision=points", "optimizer.network_lr=4e-3", "model.simulator.network.hidden=16"]
    lessons = ["plan.teach.shows=24", "plan.teach.rolls=1"]
    module, data = build(compose([f"data.root={long_toy}", *TAUGHT, *options, *lessons]))
    whole = [  # all frames, of which the first 16 are seen
        Track(0, number, data.index.ground_truth(number).positions - module.scenes[0].means) for number in range(2)
    ]

    def left() -> float:
        """Squared error of single steps from true unseen states."""
        lesson = Lesson(module, module.model, whole, Teaching(), seed=0)
        with torch.no_grad():
            return float(lesson.errors([(i, t) for i in (0, 1) for t in range(17, 27)], 1)[0])

    module.model.eval()
    untaught = left()
    begin(module, data, module.plan, seed=0, quiet=True)
    own = torch.stack([known.moved[:16] for known in whole])
    speed, middle = own.diff(dim=1).square().sum(), ((own[:, 1:] + own[:, :-1]) / 2).square().sum()
    frequency, loss = module.model.template.oscillator(0).tolist()
    assert frequency == pytest.approx(float((speed / middle).sqrt()), rel=0.05) and abs(loss) < 0.01
    module.model.eval()
    assert left() < 0.1 * untaught


def test_the_oscillator_has_the_frequency_and_the_loss_of_the_motions() -> None:
    fall, time = 0.03, torch.arange(16.0)  # of the amplitude, and so twice as much of the energy
    swings = [
        size * (-fall * time).exp() * (0.5 * time + phase).sin() for size, phase in ((1, 0.0), (3, 1.0), (2, 2.0))
    ]
    motions = [swing[:, None, None] * torch.ones(1, 4, 3) for swing in swings]
    frequency, loss = oscillator_of([motions[0], motions[1][:12], motions[2], torch.zeros(16, 4, 3)])
    assert frequency == pytest.approx(0.5, rel=0.06)
    assert loss == pytest.approx(1 - math.exp(-2 * fall), rel=0.2) and loss < 1 - math.exp(-2 * fall)
    assert oscillator_of(motions[:1])[1] == 0
    assert oscillator_of([*motions, motions[1].flip(0)])[1] < 0  # one that gains: nothing is certain


def test_the_plan_leaves_teaching_out_where_motion_cannot_be_tracked() -> None:
    plan = TrainingPlan(warm_start=None, teach=Teaching(shows=3))
    taught, held = plan.resolved(DataFacts(2, 16, True)), plan.resolved(DataFacts(2, 16, True, can_teach=False))
    assert taught.teach == plan.teach and taught.t_start == 15 and "teach" not in taught.settings()
    assert held.teach is None and held.settings()["teach"] is None and held.t_start == 2
    assert [p.rate_factor("network", 1.0) for p in (taught, held)] == pytest.approx([0.2 * 0.05, 0.05])
    for wrong in ({"shows": -1}, {"shows": 0, "rolls": 0}, {"noise": -1.0}):
        with pytest.raises(ConfigError, match=r"plan\.teach: expected shows and rolls"):
            Teaching(**wrong)
    with pytest.raises(ConfigError, match=r"plan\.teach\.sums: expected 0 to 1"):
        Teaching(sums=1.5)


def test_kernels_move_by_the_noise_of_their_unit_and_every_pair_is_shown_once(long_toy: Path) -> None:
    module, data = build(compose([f"data.root={long_toy}", *TAUGHT, "supervision=points"]))
    lesson = Lesson(module, module.model, track(module, data, quiet=True), Teaching(sums=1.0), seed=0)
    pairs = [start for starts in lesson.pairs() for start in starts]
    assert sorted(pairs) == [(i, t) for i in range(2) for t in range(15)]
    batch = module.model.batch([0, 0])
    shift, unit = lesson._drawn(batch, 0.1), batch.inherited
    assert torch.equal(shift[unit < 0], torch.zeros_like(shift[unit < 0])) and bool((unit >= 0).any())
    for number in unit[unit >= 0].unique():
        own = shift[unit == number]
        assert bool((own == own[0]).all()) and float(own[0].norm()) > 0
    state = lesson.state(batch, [(0, 0), (1, 3)])
    rest = module.scenes[0].means
    expected = data.index.ground_truth(1).positions
    assert torch.equal(state.positions[: len(rest)], rest)
    assert float((state.positions[len(rest) :] - rest).norm()) > 0 and expected.shape[0] == 28


def test_lessons_on_sums_are_motions_about_rest_that_begin_with_their_states(long_toy: Path) -> None:
    module, data = build(compose([f"data.root={long_toy}", *TAUGHT, "supervision=points"]))
    tracks = track(module, data, quiet=True)
    lesson = Lesson(module, module.model, tracks, Teaching(sums=1.0), seed=0)
    batch, starts = module.model.batch([0, 0]), [(0, 4), (1, 7)]
    plain, true = lesson._motion(batch, starts, 3, trained=False)
    state, summed = lesson._sums(batch, starts, 3, plain, true, trained=False)
    assert torch.equal(state.positions, summed[0]) and summed.shape == true.shape == (4, len(batch.rest), 3)
    assert not torch.allclose(summed, true)
    span = torch.stack([known.moved[t : t + 4] for known in tracks for t in range(13)])
    parts = (summed - batch.rest).unflatten(1, (2, -1))[:, 0].flatten()  # in the span of tracked motions of this length
    span = span.flatten(1).mT.double()
    left = span @ torch.linalg.lstsq(span, parts.double()[:, None]).solution - parts.double()[:, None]
    assert float(left.norm()) < 1e-3 * float(parts.norm())
    unchanged = Lesson(module, module.model, tracks, Teaching(sums=0.0), seed=0)
    assert torch.equal(unchanged._sums(batch, starts, 3, plain, true, trained=False)[1], true)
