"""The start of a training from tracked motion: what is found, and that a resumed run keeps it."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
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
    "render=cpu", "logger=none", "trainer.motion_epochs=0", "evaluate=false",
    "plan.t_max=4", "plan.repeats=1", "plan.batch_size=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_object(tmp_path_factory.mktemp("warm") / "toy", frames=8).root


MODES = "model.simulator.template.modes=6"
WARM = [MODES, "plan.warm_start.updates=60"]
CHOICES = [
    ["model=gausim", *WARM],
    pytest.param(["model=gausim_elastic", *WARM], marks=pytest.mark.slow),
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


def test_a_fit_in_modal_coordinates_finds_the_template_that_made_a_motion(toy: Path) -> None:
    torch.manual_seed(0)
    module, _ = build(compose([f"data.root={toy}", "model=gausim", MODES, *QUICK]))
    model, draws = module.model, torch.Generator().manual_seed(3)
    start = 0.1 * torch.randn(2, 6, generator=draws)
    attributes = model.attributes[0].detach().clone()
    with torch.no_grad():
        model.attributes[0].copy_(0.5 * torch.randn(attributes.shape, generator=draws))
        part, z = model.modal_scene(0), [start, 1.2 * start]
        for _ in range(6):
            z.append(part.after(z[-1], z[-2]))
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
