"""Small synthetic scenes and simulators with random, trained-looking parameters."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from gausim.core import GaussianScene, SimState
from gausim.models.step.simulator import GausSim
from gausim.models.template.finite_strain import FiniteStrain
from gausim.models.template.material import Damping, Links, MaterialTemplate
from gausim.models.template.solid import SolidSettings
from gausim.models.template.springs import Springs
from helpers.plain import FIELDS
from helpers.simulators import gausim

# The settings of `model=gausim`, small.
NEURAL = {
    "template": partial(
        MaterialTemplate, modes=9, solid=SolidSettings(0.2, 0.0, free_modes=1), links=Links(4, damping=0.0), hidden=8,
        damping=Damping(0.02, 0.02),
    ),
    "rest_inputs": True, "velocities": False, "lever": 0.02, "anchor": True,
    "body_frame": True, "edges": "rest", "attributes": 3,
}  # fmt: skip


def make_scene(count: int = 70, *, seed: int = 0, dtype: torch.dtype = torch.float32, spare: int = 6) -> GaussianScene:
    """A column of kernels whose foot is pinned; the first ``spare`` kernels are not simulated at all."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.5, 0.4, 1.2]) + 0.1
    means[spare : spare + 8, 2] *= 0.1  # at least eight pinned kernels
    simulated = torch.arange(count) >= spare
    return GaussianScene.create(
        means=means.to(dtype),
        log_scales=(torch.randn(count, 3, generator=generator, dtype=torch.float64) * 0.3 - 3).to(dtype),
        quats=torch.randn(count, 4, generator=generator, dtype=torch.float64).to(dtype),
        opacity_logits=torch.zeros(count, dtype=dtype),
        sh=torch.randn(count, 4, 3, generator=generator, dtype=torch.float64).to(dtype), simulated=simulated,
        pinned=simulated & (means[:, 2] < 0.25), name=f"column{seed}",
    )  # fmt: skip


def make_model(scenes: GaussianScene | Sequence[GaussianScene], *, seed: int = 0, **options: object) -> GausSim:
    """A simulator with random weights, densities, attributes and normaliser statistics, in evaluation mode."""
    scenes = [scenes] if isinstance(scenes, GaussianScene) else list(scenes)
    torch.manual_seed(seed)
    settings = {"radii": (0.2, 0.5), "graph_radii": (0.8, 0.35), "max_neighbours": 6, "hidden": 16, "layers": 2}
    model = gausim(scenes, [24.0 + 6 * i for i in range(len(scenes))], **(settings | options))
    model.to(scenes[0].means.dtype)
    with torch.no_grad():
        for parameter in (*model.log_density, *model.attributes):
            parameter.copy_(0.4 * torch.randn(parameter.shape))
    for i, scene in enumerate(scenes):
        for j in range(3):
            model.step(model.batch((i,)), make_state(scene, seed=j))
    return model.eval()


def neural_model(*, law: str = "solid", **options):
    """A small model=gausim in double precision."""
    return make_model(replace(make_scene(90, dtype=torch.float64), law=law), **(NEURAL | options))


def make_state(scene: GaussianScene, *, seed: int = 0, amount: float = 0.02) -> SimState:
    """Free kernels displaced at random in both frames."""
    generator = torch.Generator().manual_seed(100 + seed)
    shift = torch.randn(2, scene.count, 3, generator=generator, dtype=torch.float64).to(scene.means) * amount
    shift = shift * (scene.simulated & ~scene.pinned)[:, None]
    return SimState(scene.means + shift[0], scene.means + shift[1])


def join_states(states: Sequence[SimState]) -> SimState:
    return SimState(torch.cat([s.positions for s in states]), torch.cat([s.previous for s in states]))


def permuted(scene: GaussianScene, order: Tensor) -> GaussianScene:
    return replace(scene, **{n: getattr(scene, n)[order] for n in FIELDS})


def pull_of(
    springs: Springs | FiniteStrain, z: Tensor, factor: Tensor | float = 1.0, strain: Tensor | None = None
) -> Tensor:
    """Nonlinear force (S, M) of springs that stay in the state z (S, M)."""
    reference = None if strain is None else springs.reference_strain(strain)
    return springs.between(*[springs.strain_state(z, reference)] * 2, factor)
