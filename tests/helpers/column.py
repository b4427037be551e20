"""A small elastic column under a network with random weights, and an interaction with it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch

from gausim.core import GaussianScene, SimState
from gausim.interaction.interaction import Interaction
from gausim.interaction.session import MadeWith
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.step.simulator import GausSim
from gausim.models.template.elastic import ElasticTemplate
from helpers.simulators import gausim


def _scene(count: int = 90, *, seed: int = 0, spare: int = 5) -> GaussianScene:
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([0.5, 0.4, 1.2]) + 0.1
    means[spare : spare + 8, 2] *= 0.1
    simulated = torch.arange(count) >= spare
    return GaussianScene.create(
        means=means,
        log_scales=torch.randn(count, 3, generator=generator) * 0.3 - 3,
        quats=torch.randn(count, 4, generator=generator),
        opacity_logits=torch.zeros(count),
        sh=torch.randn(count, 4, 3, generator=generator),
        simulated=simulated,
        pinned=simulated & (means[:, 2] < 0.25),
        name="column",
    )


def _model(scene: GaussianScene, *, seed: int = 0, passive: int = 6) -> GausSim:
    torch.manual_seed(seed)
    model = gausim(
        [scene], [24.0], radii=(0.2, 0.5), graph_radii=(0.8, 0.35), max_neighbours=6, hidden=16, layers=2,
        template=partial(ElasticTemplate, modes=8), output_scale=0.01, anchor=True, energy_guard_frames=passive,
    )  # fmt: skip
    with torch.no_grad():
        for parameter in (*model.log_density, *model.attributes):
            parameter.copy_(0.4 * torch.randn(parameter.shape))
    return model.eval()


def _interaction(*, seed: int = 0, ceiling: float | None = None, **options: object) -> Interaction:
    scene = _scene()
    model, initial = _model(scene, seed=seed), SimState(scene.means, scene.means)
    dynamics = SceneDynamics(model)
    dynamics.energy_ceiling = ceiling
    made_with = MadeWith.of(scene, model, initial, run="toy")
    units = model.units_of_kernels(0)
    return Interaction(scene, dynamics, dynamics.masses, initial, made_with=made_with, units=units, **options)


@pytest.fixture(scope="session")
def make_column() -> Callable[..., GaussianScene]:
    return _scene


@pytest.fixture(scope="session")
def make_simulator() -> Callable[..., GausSim]:
    return _model


@pytest.fixture(scope="session")
def make_interaction() -> Callable[..., Interaction]:
    return _interaction
