"""The start of a training from tracked motion: what is found, and that a resumed run keeps it."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.simulators import SMALLEST
from helpers.toy_object import write_toy_object
from helpers.toy_runs import rows

from gausim.cli import train
from gausim.compose.build import build
from gausim.compose.config import compose
from gausim.runs.checkpoint import read_checkpoint
from gausim.training import modal_fit
from gausim.training.optimizers import OptimizerSettings
from gausim.training.plan import WarmStart
from gausim.training.tracking import Track
from gausim.training.warm_start import warm_start

QUICK = [x for x in SMALLEST if "warm_start" not in x] + [
    "model.simulator.template.modes=6", "render=cpu", "logger=none", "trainer.motion_epochs=0", "evaluate=false",
    "plan.t_max=4", "plan.repeats=1", "plan.batch_size=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_object(tmp_path_factory.mktemp("warm") / "toy", frames=8).root


@pytest.mark.parametrize(
    "choice",
    [
        ["model=gausim"],
        pytest.param(["model=gausim_elastic"], marks=pytest.mark.slow),
        pytest.param(["model=gausim", "supervision=points"], marks=pytest.mark.slow),
    ],
)
def test_training_starts_near_the_motion_and_a_resumed_run_starts_from_its_checkpoint(
    toy: Path, tmp_path: Path, choice: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    common = [f"data.root={toy}", *choice, *QUICK, "plan.warm_start.updates=60"]
    assert train.main([*common, "plan.epochs=2", f"hydra.run.dir={tmp_path / 'whole'}"]) == 0
    printed = capsys.readouterr().out
    assert "track: 2 sequences; of the 2 whose true motion is known" in printed and "warm start: " in printed
    first = float(rows(tmp_path / "whole/epochs.csv")[0]["excess_static"])
    bare = [*common[:-1], "plan.warm_start=null", "plan.epochs=1"]
    assert train.main([*bare, f"hydra.run.dir={tmp_path / 'bare'}"]) == 0
    capsys.readouterr()
    cold = float(rows(tmp_path / "bare/epochs.csv")[0]["excess_static"])
    assert first < 0.5 * cold
    cut = f"hydra.run.dir={tmp_path / 'cut'}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gausim.training.module.GausSimModule.on_train_epoch_end", _interrupt)
        with pytest.raises(RuntimeError, match="cut"):
            train.main([*common, "plan.epochs=2", "trainer.checkpoint_steps=1", cut])
    assert train.main([*common, "plan.epochs=2", "trainer.checkpoint_steps=1", cut]) == 0
    assert "warm start" not in capsys.readouterr().out.split("resuming")[1]
    whole, again = (read_checkpoint(tmp_path / n / "last.ckpt")["state_dict"] for n in ("whole", "cut"))
    assert all(torch.equal(value, again[name]) for name, value in whole.items())


def _interrupt(module: object) -> None:
    raise RuntimeError("cut")


def test_a_fit_in_modal_coordinates_finds_the_template_that_made_a_motion(toy: Path) -> None:
    torch.manual_seed(0)
    module, _ = build(compose([f"data.root={toy}", "model=gausim", *QUICK]))
    model, draws = module.model, torch.Generator().manual_seed(3)
    start = 0.1 * torch.randn(2, 6, generator=draws)
    attributes = model.attributes[0].detach().clone()
    with torch.no_grad():
        model.attributes[0].copy_(0.5 * torch.randn(attributes.shape, generator=draws))
        part, z = model.modal_scene(0), [start, 1.2 * start]
        for _ in range(12):
            z.append(part.after(z[-1], z[-2]))
        model.attributes[0].copy_(attributes)
    true = torch.stack(z)
    size = modal_fit.size_of(true.movedim(0, 1))

    def known(steps: int) -> modal_fit.KnownMotion:
        return modal_fit.KnownMotion(size, true[0], true[1], true[2 : 2 + steps])

    groups = {"scene": [model.attributes[0]]}
    settings = OptimizerSettings(scene_lr=0.1)
    losses = list(modal_fit.fit(model, [(0, known)], settings, groups, longest=12, updates=150))
    before = float(known(12).error(part))
    assert before == pytest.approx(0.0, abs=1e-4)
    assert losses[-1] < 1e-2 and float(known(12).error(model.modal_scene(0))) < 0.1 * 12

    def astray(steps: int) -> modal_fit.KnownMotion:
        motion = known(steps)
        return motion if len(later) < 45 else replace(motion, after=5 * motion.after)

    later: list[float] = []
    for loss in modal_fit.fit(model, [(0, astray)], settings, groups, longest=12, updates=60):
        later.append(loss)
    distances = torch.stack([d.mean() for d in known(12).distances(model.modal_scene(0))])
    assert len(later) == 60 and later[-2] > 1 and later[-1] == min(later[30:])
    assert float(distances.mean()) == pytest.approx(later[-1], rel=1e-4)


@pytest.mark.parametrize("law", ["solid", "springs"])
@torch.no_grad()
def test_initial_states_are_found_in_the_motion_of_a_frozen_model(toy: Path, law: str) -> None:
    torch.manual_seed(0)
    module, _ = build(compose([f"data.root={toy}", "model=gausim", f"data.law={law}", *QUICK]))
    states, true = module.initial_states, 0.7 * torch.randn(2, 6)
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


def test_the_fit_has_the_settings_of_the_model_and_what_it_leaves_is_said(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[int] = []

    def fit(model, motions, settings, groups, *, longest, updates, growing):
        assert growing == 0.25 and settings.decay["scene"] == 0.05  # of model=gausim
        seen.append(updates)
        yield 0.2

    monkeypatch.setattr(modal_fit, "fit", fit)
    common = [f"data.root={toy}", "model=gausim", *QUICK, "plan.epochs=1", "plan.warm_start.updates=60"]
    assert train.main([*common, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    assert seen == [60] and "without a network 0.200 of the motion is left" in capsys.readouterr().out
