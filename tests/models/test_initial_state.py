from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bodies import make_model, make_scene
from helpers.sway import real_module, sample
from torch import Tensor

from gausim.models.initial_state import FreeInitialStates, ModalInitialStates
from gausim.models.template import solid
from gausim.models.template.material import MaterialTemplate
from gausim.training.module import GausSimModule
from gausim.training.rollout import windows


@pytest.fixture
def model():
    template = partial(MaterialTemplate, modes=5)
    return make_model([make_scene(60), make_scene(50, seed=1)], template=template)


@pytest.mark.parametrize("kind", [FreeInitialStates, ModalInitialStates])
def test_starts_at_rest_and_moves_only_free_kernels_of_its_sequence(model, kind) -> None:
    initial = kind(model, [0, 1, 0])
    parameters = list(initial.parameters())
    assert len(parameters) == 3
    for number, scene_id in enumerate((0, 1, 0)):
        scene = model.scenes[scene_id]
        assert torch.equal(initial.state(number).previous, scene.means)
        with torch.no_grad():
            parameters[number].copy_(torch.randn(parameters[number].shape))
        moved = initial.state(number).previous.detach() - scene.means
        free = scene.simulated & ~scene.pinned
        assert not bool(moved[~free].any())
        assert float(moved[free].norm(dim=-1).min()) > 0
    initial.state(2).previous.square().sum().backward()
    assert [p.grad is not None for p in parameters] == [False, False, True]


def test_modal_velocity_moves_units_as_the_basis_says(model) -> None:
    initial = ModalInitialStates(model, [0])
    velocity = torch.randn(5, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        initial.velocity[0].copy_(velocity)
    scene, hierarchy = model.scenes[0], model.hierarchies[0]
    moved = (scene.means - initial.state(0).previous.detach())[hierarchy.kernels]
    level, unit = hierarchy.levels[1], hierarchy.ancestor(0, 1)
    modes, deformation_gradients, sizes = model.template.basis(0)
    modes, deformation_gradients = modes / sizes, deformation_gradients / sizes
    for c in (~level.pinned).nonzero()[:, 0].tolist():
        weight = hierarchy.levels[0].volume[unit == c, None]
        centre = (weight * moved[unit == c]).sum(0) / weight.sum()
        assert torch.allclose(centre, modes[c] @ velocity, atol=1e-5)
        offset = scene.means[hierarchy.kernels][unit == c] - level.rest[c]
        within = moved[unit == c] - modes[c] @ velocity
        assert torch.allclose(within, offset @ (deformation_gradients[c] @ velocity).T, atol=1e-5)


def test_a_rest_template_has_the_modes_of_an_even_solid() -> None:
    simulator = make_model(make_scene(40))
    motions, free = simulator.smooth_motions(0), simulator.scenes[0].simulated & ~simulator.scenes[0].pinned
    assert motions.count == len(motions.sizes) and bool((motions.kernels[~free] == 0).all())
    assert bool((motions.kernels[free].norm(dim=(0, 1)) > 0).all()) and bool((motions.sizes.diff() <= 0).all())
    initial = ModalInitialStates(simulator, [0])
    shown = 0.3 * motions.kernels[..., 0]
    initial.set_motion(0, shown)
    torch.testing.assert_close(initial.motion(0).float(), shown, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("kind", [FreeInitialStates, ModalInitialStates])
def test_reach_is_the_largest_motion_of_a_change_where_it_is_least(model, kind) -> None:
    initial = kind(model, [0, 1])
    furthest = []
    for number, scene in enumerate(model.scenes):
        with torch.no_grad():
            list(initial.parameters())[number][..., :1] = 0.3  # one direction of a free offset, the first amplitude
        moved = (initial.state(number).previous - scene.means).norm(dim=-1)
        furthest.append(float(moved.detach().max()) / scene.diagonal)
    assert initial.reach(0.3) == pytest.approx(min(furthest), rel=1e-5)


def _module() -> GausSimModule:
    template = partial(MaterialTemplate, modes=6)  # the elastic one fixes the signs of its modes
    return real_module((0, 0), template=template, states=ModalInitialStates)


@torch.no_grad()
def _rolled(module: GausSimModule) -> Tensor:
    samples = [sample(0), sample(0)]
    batch = module.simulator.batch([0, 0])
    ((_, steps),) = windows(module.simulator, batch, module.method.initial(samples, batch), 4, 4)
    return torch.stack([step.positions for step in steps])


def test_a_run_moves_alike_where_eigenvectors_have_other_signs(monkeypatch: pytest.MonkeyPatch) -> None:
    run = _module().eval()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, parameter in run.named_parameters():
            if "template" in name or "velocity" in name:
                parameter += 0.05 * torch.randn(parameter.shape, generator=generator)
    expected, still = _rolled(run), run.simulator.batch([0, 0]).rest

    def turned(own: Any, *given: Any, **options: Any) -> tuple[np.ndarray, np.ndarray]:
        values, vectors = own(*given, **options)
        return values, vectors * np.where(np.arange(vectors.shape[1]) % 2, -1.0, 1.0)

    monkeypatch.setattr(solid, "lowest", partial(turned, solid.lowest))
    other = _module().eval()
    other.load_state_dict(run.state_dict())
    found = _rolled(other)
    assert float((found - expected).norm() / (expected - still).norm()) < 1e-4
