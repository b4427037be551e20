"""The regulariser of free motion: growth by formula, its gradient, and what training logs and refuses."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from helpers import sway, toy_object
from helpers.simulators import gausim
from torch import Tensor

from gausim.core import ConfigError, SimState
from gausim.losses import Objective
from gausim.models.initial_state import FreeInitialStates
from gausim.models.template.elastic import ElasticTemplate
from gausim.models.template.template import RestTemplate, Template
from gausim.render.cpu import CpuRenderer
from gausim.training.method import SharedSimulator
from gausim.training.module import GausSimModule
from gausim.training.terms.free_motion import energy_growth

SCENE_OF_SEQUENCE = sway.SCENE_OF_SEQUENCE
sample, sway_module = sway.sample, sway.sway_module


class Spiral:
    """Two members whose distance from rest grows by a factor per frame, each by its own."""

    knows_energy = True

    def __init__(self, factor: Tensor) -> None:
        self.factor, self.batch_of = factor, SimpleNamespace(rest=torch.arange(12.0).view(4, 3), members=(0, 1))
        self.scenes, self.sizes = (), []

    def prepare(self, batch: object) -> None:
        return None

    def step(self, batch: SimpleNamespace, state: SimState, force: object = None, prepared: object = None) -> object:
        factor = self.factor.repeat_interleave(2)[:, None]
        positions = batch.rest + factor * (state.positions - batch.rest)
        return SimpleNamespace(positions=positions, deformation_gradients=None, rotations=None, momentum=None)

    def energy(self, batch: SimpleNamespace, state: SimState, prepared: object = None) -> Tensor:
        self.sizes.append(float((state.positions - batch.rest).abs().max()))
        return (state.positions - batch.rest).square().view(2, 6).sum(1)

    def batch(self, scene_ids: object) -> object: ...
    def parameter_groups(self) -> object: ...


def test_growth_is_that_of_the_mean_energy_from_stretch_to_stretch() -> None:
    factor = torch.tensor([1.02, 0.9], requires_grad=True)
    model = Spiral(factor)
    state = SimState(model.batch_of.rest + 0.1, model.batch_of.rest)
    draws = torch.Generator().manual_seed(0)
    found = list(energy_growth(model, model.batch_of, state, 15, 5, draws))
    assert len(found) == 2  # the first stretch is what the second is compared with
    for growth in found:
        assert growth.tolist() == pytest.approx([10 * math.log(1.02), 0.0], rel=1e-4)
    (slope,) = torch.autograd.grad(found[1].sum(), factor)  # gradients stop where the stretch begins
    powers = 2 * torch.arange(1, 6)
    weights = 1.02**powers
    expected = float((weights * powers / 1.02).sum() / weights.sum())
    assert slope.tolist() == pytest.approx([expected, 0.0], rel=1e-4)


def test_motion_goes_on_at_a_random_size() -> None:
    sizes = []
    for seed in range(20):
        model = Spiral(torch.tensor([1.5, 1.0]))
        state = SimState(model.batch_of.rest + 0.1, model.batch_of.rest)
        growth = list(energy_growth(model, model.batch_of, state, 8, 4, torch.Generator().manual_seed(seed)))
        assert growth[0].tolist() == pytest.approx([8 * math.log(1.5), 0.0], rel=1e-4)
        sizes.append(model.sizes[0] / (0.1 * 1.5))
    assert 0.2 <= min(sizes) < 0.5 < 1.0 < max(sizes) <= 1.5


def test_what_explodes_is_not_learned_from() -> None:
    model = Spiral(torch.tensor([1.0, 1e12], requires_grad=True))
    state = SimState(model.batch_of.rest + 0.1, model.batch_of.rest)
    assert list(energy_growth(model, model.batch_of, state, 9, 3, torch.Generator())) == []


def _module(objective: Objective, template: Callable[..., Template]) -> GausSimModule:
    torch.manual_seed(0)
    scenes = [toy_object.toy_scene(), toy_object.toy_scene()]
    model = gausim(scenes, [24.0, 24.0], radii=(0.3, 0.7), hidden=8, layers=1, template=template)
    states = FreeInitialStates(model, SCENE_OF_SEQUENCE)
    for offset in states.offset:
        torch.nn.init.normal_(offset, std=1e-3)
    return GausSimModule(
        method=SharedSimulator(model, states, SCENE_OF_SEQUENCE),
        renderer=CpuRenderer(threads=1),
        objective=objective,
    )  # fmt: skip


ELASTIC = partial(ElasticTemplate, modes=6, neighbours=6)


def test_training_carries_it_as_often_as_asked_and_repeats_itself() -> None:
    seen, grads = [], []
    for weight, chance in ((1.0, 1.0), (1.0, 1.0), (0.0, 1.0), (1.0, 0.0)):
        objective = Objective(energy_weight=weight, energy_probability=chance, energy_frames=8, energy_stretch=4)
        module = _module(objective, ELASTIC)
        stats = module.optimise([sample(0), sample(2)], module.configure_optimizers(), torch.Generator().manual_seed(3))
        seen.append("energy_growth" in stats)
        grads.append(torch.cat([p.grad.flatten() for p in module.parameters() if p.grad is not None]))
    assert seen == [True, True, False, False]
    assert torch.equal(grads[0], grads[1])


def test_members_of_several_scenes_have_their_own_energies() -> None:
    model = _module(Objective(), ELASTIC).model
    batch = model.batch([1, 0, 1])
    moved = batch.rest + 0.01 * torch.randn(batch.rest.shape, generator=torch.Generator().manual_seed(0))
    together = model.energy(batch, SimState(moved, batch.rest))
    for i, scene_id in enumerate((1, 0, 1)):
        own, rows = model.batch([scene_id]), batch.members[i].kernels
        alone = model.energy(own, SimState(moved[rows], batch.rest[rows]))
        torch.testing.assert_close(together[i : i + 1], alone)
    assert bool((together > 0).all())
    assert float(model.energy(batch, SimState(batch.rest, batch.rest)).abs().max()) < 1e-9


def test_models_and_templates_without_energy_are_refused_and_null_asks_those_that_have_one() -> None:
    asked = Objective(energy_weight=1.0)
    with pytest.raises(ConfigError, match=r"energy_weight is 1.0, but Sway knows no energy"):
        sway_module(objective=asked)
    with pytest.raises(ConfigError, match=r"energy_weight is 1.0, but RestTemplate knows no energy"):
        _module(asked, RestTemplate)
    either = Objective(energy_weight=None)
    assert [_module(either, template).free_motion.weight for template in (RestTemplate, ELASTIC)] == [0.0, 1.0]


@pytest.mark.parametrize("wrong", [{"energy_weight": -1.0}, {"energy_probability": 2.0}, {"energy_stretch": 40}])
def test_settings_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="energy"):
        Objective(**wrong)
