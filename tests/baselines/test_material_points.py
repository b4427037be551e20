"""PhysDreamer and PhysGaussian: kernels and their particles, a known material found again, units, messages."""

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from helpers.fitted_methods import recorded, rolled
from helpers.toy_object import toy_scene
from torch import Tensor

pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")

from gausim.baselines.fitted import FittedDynamics, FittedState
from gausim.baselines.material_point.driven import clustered
from gausim.baselines.material_point.method import Discretisation, MaterialPoints
from gausim.baselines.material_point.physdreamer import ModulusField, PhysDreamer
from gausim.baselines.material_point.physgaussian import PhysGaussian
from gausim.baselines.mpm import Filling, Grid, Material, MPMSolver, Particles, ParticleState, TimeStep
from gausim.core import Floor, GaussianScene, SimState, Surroundings
from gausim.ops.rotation import quaternion_to_matrix

TRUE = 1e5


def grouped(options: dict[str, Any], **groups: type) -> dict[str, Any]:
    """Options in the groups whose fields they are."""
    made = {}
    for group, kind in groups.items():
        made[group] = kind(**{f.name: options.pop(f.name) for f in fields(kind) if f.name in options})
    return {**options, **made}


def dreamer(scene: GaussianScene | None = None, **options: Any) -> PhysDreamer:
    options = {"particles": 36, "cells": 12, "young_modulus": TRUE, "poisson_ratio": 0.3, "density": 2000.0} | options
    options = grouped(options, material=Material, discretisation=Discretisation, modulus=ModulusField)
    return PhysDreamer(**recorded(scene or toy_scene()), **options)


def gaussian(scene: GaussianScene | None = None, **options: Any) -> PhysGaussian:
    options = grouped({"cells": 14, "young_modulus": 3e4} | options, material=Material, discretisation=Discretisation)
    return PhysGaussian(**recorded(scene or toy_scene()), **options)


def swaying(method: MaterialPoints, speed: float = 0.8) -> FittedState:
    """The beginning of sequence 0, but with a velocity along x that grows with the height squared."""
    state, driven = method.begin(0), method.body(0).driven
    velocity = torch.zeros_like(driven.rest)
    velocity[:, 0] = speed * method.domain.side * driven.rest[:, 2] ** 2 * ~driven.pinned
    return replace(state, inner=(state.inner[0], velocity, *state.inner[2:]))


def test_kernels_follow_an_affine_motion_of_their_particles_exactly() -> None:
    scene = replace(toy_scene(), pinned=torch.zeros(36, dtype=torch.bool))
    driven = clustered(scene, 12)
    assert len(driven.rest) == 12 and driven.followed.shape == (36, 8)
    turn = quaternion_to_matrix(torch.tensor([0.96, 0.2, -0.1, 0.3]))
    wanted = turn @ torch.diag(torch.tensor([1.2, 0.9, 1.05]))
    shift = torch.tensor([0.4, -0.2, 0.1])
    positions, gradients, rotations = driven.carried(driven.rest @ wanted.T + shift, wanted.expand(12, 3, 3))
    torch.testing.assert_close(positions, scene.means @ wanted.T + shift, rtol=0, atol=2e-6)
    torch.testing.assert_close(gradients, wanted.expand(36, 3, 3), rtol=0, atol=1e-6)
    u, _, vt = torch.linalg.svd(wanted)
    torch.testing.assert_close(rotations, (u @ vt).expand(36, 3, 3), rtol=0, atol=1e-5)


def test_filled_interiors_are_particles_and_pinned_near_pins() -> None:
    scene = replace(toy_scene(), log_scales=torch.full((36, 3), math.log(0.2)))
    filling = Filling(cells=16, dense=0.5, per_cell=2)
    method = gaussian(scene, filling=filling)
    driven = method.body(0).driven
    assert f"the interior filled with {len(driven.rest) - 36} points" in method.notes()[-1]
    assert "the interior filled with nothing" in gaussian(scene).notes()[-1]
    assert len(driven.rest) > 36 and torch.equal(driven.rest[:36], scene.means)
    interior, pinned = driven.rest[36:], driven.pinned[36:]
    assert torch.equal(pinned, scene.pinned[torch.cdist(interior, scene.means).argmin(1)])
    assert 0 < pinned.sum() < len(pinned)
    clusters = dreamer(scene, filling=filling, particles=10_000).body(0).driven
    assert len(clusters.rest) > 36 and int(clusters.pinned.sum()) > int(scene.pinned.sum())


@pytest.mark.parametrize("make", [dreamer, gaussian])
def test_what_begins_at_rest_stays_at_rest_and_what_is_held_stays(make: Callable[..., MaterialPoints]) -> None:
    outside = torch.arange(36) == 35
    method = make(replace(toy_scene(), simulated=~outside))
    rest, held = toy_scene().means, method.body(0).driven.held
    with torch.no_grad():
        for state in rolled(method, 3):
            torch.testing.assert_close(state.positions, rest, rtol=0, atol=1e-6)
        states = rolled(method, 5, swaying(method))
    assert int(held.sum()) == 10
    for state in states:
        assert torch.equal(state.positions[held], rest[held])
        assert torch.equal(state.deformation_gradients[held], torch.eye(3).expand(10, 3, 3))
    assert float((states[-1].positions - rest)[~held].norm(dim=1).min()) > 1e-3


def test_physgaussian_moves_as_the_material_point_method_moves_its_scene() -> None:
    scene, method = toy_scene(), gaussian(poisson_ratio=0.3)
    begun, mapping, grid = swaying(method), method.body(0).mapping, Grid(cells=14, size=2.0)
    x = mapping.to_simulation(scene.means)
    particles = Particles.create(x, grid=grid, density=200.0, pinned=scene.pinned)
    material = Material(young_modulus=3e4, poisson_ratio=0.3, density=200.0)
    solver = MPMSolver(particles, material, grid, TimeStep(1 / 24, courant=0.5))
    wanted = [ParticleState.at_rest(x, begun.inner[1])]
    with torch.no_grad():
        states = rolled(method, 4, begun)
        for frame in range(4):
            wanted.append(solver.advance(wanted[-1], frame, young_modulus=method.modulus(0)))
    moved = float((mapping.to_scene(wanted[-1].positions) - scene.means).norm(dim=1).max())
    assert moved > 0.05
    free = ~scene.pinned
    for made, true in zip(states, wanted, strict=True):
        torch.testing.assert_close(made.positions, mapping.to_scene(true.positions), rtol=0, atol=1e-3 * moved)
        gradients = (x.deformation_gradients[free] for x in (made, true))
        torch.testing.assert_close(*gradients, rtol=0, atol=1e-3)


def observed(method: PhysDreamer, frames: int) -> list[Tensor]:
    with torch.no_grad():
        return [state.positions for state in rolled(method, frames, swaying(method))]


def misfit(method: PhysDreamer, targets: list[Tensor], frames: int, begun: FittedState | None = None) -> Tensor:
    states = rolled(method, frames, begun)[1:]
    return torch.stack([(s.positions - t).square().mean() for s, t in zip(states, targets[1:], strict=False)]).sum()


def test_the_gradient_with_respect_to_the_modulus_is_its_difference_quotient() -> None:
    targets, method = observed(dreamer(), 5), dreamer(young_modulus=TRUE / 10, most_substeps=25)
    bias = method.modulus_field[0].network[-1].bias  # type: ignore[index,union-attr]
    loss = misfit(method, targets, 5, swaying(method))
    (slope,) = torch.autograd.grad(loss, [bias])
    values = []
    with torch.no_grad():
        for step in (0.02, -0.02):
            bias.fill_(step)  # type: ignore[operator,union-attr]
            values.append(float(misfit(method, targets, 5, swaying(method))))
    assert float(slope) == pytest.approx((values[0] - values[1]) / 0.04, rel=0.01)
    assert float(slope) < 0  # stiffer is better


def test_sequences_share_the_modulus_and_nothing_else() -> None:
    method = dreamer()
    state = method.advance(replace(swaying(method), sequence_id=1))
    state.positions.square().sum().backward()
    grads = {name: [p.grad is not None for p in own] for name, own in method.parameter_groups().items()}
    assert sorted(grads) == ["modulus", "velocity"] and any(grads["modulus"]) and not any(grads["velocity"])
    second = method.begin(1).inner[1].sum()
    second.backward()
    assert all(p.grad is None for p in method.velocity[0].parameters())
    assert any(p.grad is not None for p in method.velocity[1].parameters())
    assert sorted(method.penalties(1)) == ["modulus_variation", "velocity_variation"]


def falling_scene() -> GaussianScene:
    scene = toy_scene()
    floor = Floor((0.0, 0.0, -0.4), (0.0, 0.0, 1.0))
    around = Surroundings(free=True, gravity=(0.0, 0.0, -4.0), floor=floor)
    return replace(scene, pinned=torch.zeros_like(scene.pinned), surroundings=around)


def test_a_free_body_begins_where_it_was_fitted_falls_and_stays_above_the_floor() -> None:
    method = gaussian(falling_scene())
    with torch.no_grad():
        method.shift[0] = torch.tensor([0.1, 0.0, 0.05])
    rest = method.scenes[0].means
    longest = float((rest.amax(0) - rest.amin(0)).max())
    moved = FittedDynamics(method, 0).rollout(SimState(rest, rest), 20).positions
    shift = longest * torch.tensor([0.1, 0.0, 0.05])
    torch.testing.assert_close(moved[0], rest + shift)
    t = torch.arange(8) / 24
    fallen = moved[:8].mean(1) - moved[0].mean(0)
    torch.testing.assert_close(fallen[:, 2], -2 * t**2, atol=2e-3, rtol=0.02)
    cell = longest * 2 / 14
    assert moved[..., 2].min() > -0.4 - 0.3 * cell
    assert moved[20, :, 2].mean() > -0.2, "it fell through the floor"


def test_loss_gradients_reach_the_place_where_a_free_body_begins() -> None:
    method = gaussian(falling_scene())
    method.advance(method.begin(1)).positions[:, 0].mean().backward()
    rest = method.scenes[0].means
    longest = float((rest.amax(0) - rest.amin(0)).max())
    assert method.shift.grad[1, 0] == pytest.approx(longest, rel=1e-3)
    assert method.shift.grad[0].abs().max() == 0
    assert any(p is method.shift for p in method.parameter_groups()["velocity"])
