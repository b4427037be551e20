"""The regulariser of free motion: growth by formula, its gradient, and what training logs and refuses."""

import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace

import pytest
import torch
from helpers import sway
from torch import Tensor, nn

from gausim.core import Frame, SimState
from gausim.losses.objective import EnergyLoss, Objective
from gausim.models.template.template import Template
from gausim.training.graphed import GraphedRollouts
from gausim.training.module import GausSimModule
from gausim.training.terms.free_motion import energy_growth

sample, sway_module, ELASTIC = sway.sample, sway.sway_module, sway.ELASTIC


class Spiral(nn.Module):
    """Two members whose distance from rest grows by a factor per frame, each by its own."""

    knows_energy = True

    def __init__(self, factor: Tensor) -> None:
        super().__init__()
        self.factor, self.batch_of = factor, SimpleNamespace(rest=torch.arange(12.0).view(4, 3), members=(0, 1))
        self.scenes, self.sizes = (), []

    def prepare(self, batch: object, **options: bool) -> None:
        return None

    def step(self, batch: SimpleNamespace, state: SimState, force: object = None, prepared: object = None) -> object:
        factor = self.factor.repeat_interleave(2)[:, None]
        positions = batch.rest + factor * (state.positions - batch.rest)
        identity = torch.eye(3).expand(2, 3, 3)
        return Frame(positions, identity, identity)

    def energy(self, batch: SimpleNamespace, state: SimState, prepared: object = None) -> Tensor:
        self.sizes.append(float((state.positions - batch.rest).abs().max()))
        return (state.positions - batch.rest).square().view(2, 6).sum(1)

    def batch(self, scene_ids: object) -> object: ...
    def parameter_groups(self) -> object: ...


def test_growth_is_that_of_the_mean_energy_and_nothing_of_an_explosion() -> None:
    factor = torch.tensor([1.02, 0.9], requires_grad=True)
    model = Spiral(factor)
    state = SimState(model.batch_of.rest + 0.1, model.batch_of.rest)
    draws = torch.Generator().manual_seed(0)
    found = list(energy_growth(model, model.batch_of, state, 15, 5, draws, GraphedRollouts(model)))
    assert len(found) == 2  # the first stretch is what the second is compared with
    for growth in found:
        assert growth.tolist() == pytest.approx([10 * math.log(1.02), 0.0], rel=1e-4)
    (slope,) = torch.autograd.grad(found[1].sum(), factor)  # gradients stop where the stretch begins
    powers = 2 * torch.arange(1, 6)
    weights = 1.02**powers
    expected = float((weights * powers / 1.02).sum() / weights.sum())
    assert slope.tolist() == pytest.approx([expected, 0.0], rel=1e-4)
    model = Spiral(torch.tensor([1.0, 1e12], requires_grad=True))
    state = SimState(model.batch_of.rest + 0.1, model.batch_of.rest)
    assert list(energy_growth(model, model.batch_of, state, 9, 3, torch.Generator(), GraphedRollouts(model))) == []


def _module(objective: Objective, template: Callable[..., Template], scenes: Sequence[int] = (0,)) -> GausSimModule:
    module = sway.real_module(scenes, template=template, parts={"objective": objective})
    for offset in module.initial_states.offset:
        torch.nn.init.normal_(offset, std=1e-3)
    return module


def test_training_carries_it_as_often_as_asked_and_repeats_itself() -> None:
    seen, grads = [], []
    for weight, chance in ((1.0, 1.0), (1.0, 1.0), (0.0, 1.0), (1.0, 0.0)):
        objective = Objective(energy=EnergyLoss(weight=weight, probability=chance, frames=8, stretch=4))
        module = _module(objective, ELASTIC)
        stats = module.optimise([sample(0)], module.configure_optimizers(), torch.Generator().manual_seed(3))
        seen.append("energy_growth" in stats)
        grads.append(torch.cat([p.grad.flatten() for p in module.parameters() if p.grad is not None]))
    assert seen == [True, True, False, False]
    assert torch.equal(grads[0], grads[1])


def test_members_of_several_scenes_have_their_own_energies() -> None:
    model = _module(Objective(), ELASTIC, (0, 1)).model
    batch = model.batch([1, 0, 1])
    moved = batch.rest + 0.01 * torch.randn(batch.rest.shape, generator=torch.Generator().manual_seed(0))
    together = model.energy(batch, SimState(moved, batch.rest))
    for i, scene_id in enumerate((1, 0, 1)):
        own, rows = model.batch([scene_id]), batch.members[i].kernels
        alone = model.energy(own, SimState(moved[rows], batch.rest[rows]))
        torch.testing.assert_close(together[i : i + 1], alone)
    assert bool((together > 0).all())
    assert float(model.energy(batch, SimState(batch.rest, batch.rest)).abs().max()) < 1e-9
