"""Gradients of a frame against finite differences of the same frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")

from gausim.baselines.mpm import (  # noqa: E402
    Grid,
    Material,
    MPMSolver,
    Particles,
    ParticleState,
    TimeStep,
)

# The block's window of nodes begins beside the origin and ends before the border.
GRID = Grid(cells=24, size=2.4, gravity=(0.0, 0.0, -1.0), damping=0.5)
FRAME_TIME, SUBSTEPS = 0.06, 20
ELASTIC = Material(young_modulus=30.0, poisson_ratio=0.3, density=1.0)


def scene(lattice, material: Material = ELASTIC) -> tuple[MPMSolver, ParticleState, Tensor]:
    """A strained, moving block, one of its sides pinned; 96 particles of different moduli."""
    generator = torch.Generator().manual_seed(0)
    x = lattice((1.1, 1.2, 1.1), (1.4, 1.4, 1.3), 1 / 20)
    x = x + 0.01 * torch.rand(x.shape, generator=generator)
    particles = Particles.create(x, grid=GRID, density=material.density, pinned=x[:, 0] < 1.15)
    solver = MPMSolver(particles, material, GRID, TimeStep(FRAME_TIME, SUBSTEPS))

    def noise(*shape: int) -> Tensor:
        return torch.randn(len(x), *shape, generator=generator)

    F = torch.eye(3) + 0.05 * noise(3, 3)
    state = ParticleState(x, 0.5 * noise(3), noise(3, 3), F)
    return solver, state, torch.log(torch.tensor(material.young_modulus)) + 0.3 * noise()


def loss_of(solver: MPMSolver, state: ParticleState, log_young: Tensor, frames: int = 1) -> Tensor:
    """A smooth number in which every part of the final state counts; float64 sums."""
    for frame in range(frames):
        state = solver.advance(state, frame, young_modulus=log_young.exp())
    generator = torch.Generator().manual_seed(7)
    total = torch.zeros((), dtype=torch.float64)
    for value, weight in zip(state.tensors(), (10.0, 1.0, 0.02, 1.0), strict=True):
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        total = total + weight * (direction * value.double()).sum()
    return total


def differences(function: Callable[[Tensor], Tensor], at: Tensor, directions: list[Tensor], step: float) -> Tensor:
    with torch.no_grad():
        return torch.stack([(function(at + step * d) - function(at - step * d)) / (2 * step) for d in directions])


def compared(name: str, function: Callable[[Tensor], Tensor], at: Tensor, step: float) -> float:
    """Relative error of directional derivatives in 6 random directions, printed and returned."""
    variable = at.clone().requires_grad_()
    function(variable).backward()
    generator = torch.Generator().manual_seed(3)
    directions = [torch.randn(at.shape, generator=generator) for _ in range(6)]
    true = differences(function, at, directions, step)
    found = torch.stack([(variable.grad.double() * d.double()).sum() for d in directions])
    error = float((found - true).norm() / true.norm())
    print(f"{name}: relative error {error:.1e}")
    return error


STEPS = {"positions": 1e-4, "velocities": 1e-2, "affine": 1e-1, "deformation_gradients": 1e-3}


@pytest.mark.parametrize("field", STEPS)
def test_gradients_with_respect_to_the_state(lattice, field: str):
    solver, state, log_young = scene(lattice)
    error = compared(
        field, lambda v: loss_of(solver, replace(state, **{field: v}), log_young), getattr(state, field), STEPS[field]
    )
    assert error < 1e-2


def test_gradient_with_respect_to_the_logarithm_of_young_modulus(lattice):
    solver, state, log_young = scene(lattice)
    assert compared("log E", lambda v: loss_of(solver, state, v), log_young, 2e-2) < 1e-2


def test_gradients_through_two_frames(lattice):
    solver, state, log_young = scene(lattice)
    error = compared(
        "v0, two frames", lambda v: loss_of(solver, replace(state, velocities=v), log_young, 2), state.velocities, 1e-2
    )
    assert error < 1e-2
    assert compared("log E, two frames", lambda v: loss_of(solver, state, v, 2), log_young, 2e-2) < 1e-2


def test_gradient_with_respect_to_the_acceleration(lattice):
    solver, state, log_young = scene(lattice)

    def loss(a: Tensor) -> Tensor:
        end = solver.advance(state, 0, young_modulus=log_young.exp(), acceleration=a)
        return (end.positions.double() ** 2).sum() + (end.velocities.double() ** 2).sum()

    assert compared("acceleration", loss, torch.zeros_like(state.positions), 1e-1) < 1e-2


def test_a_frame_at_rest_has_finite_gradients(lattice):
    """All stretches are equal there, where the derivative of a singular value decomposition is not defined."""
    solver, state, log_young = scene(lattice)
    still = ParticleState.at_rest(state.positions)
    error = compared(
        "at rest", lambda v: loss_of(solver, replace(still, velocities=v), log_young), still.velocities, 1e-2
    )
    assert error < 1e-2


def test_detached_frames_and_no_grad_record_nothing(lattice):
    solver, state, log_young = scene(lattice)
    log_young.requires_grad_()
    end = solver.advance(state, 0, young_modulus=log_young.exp())
    assert end.positions.requires_grad and not end.detach().positions.requires_grad
    with torch.no_grad():
        again = solver.advance(state, 0, young_modulus=log_young.exp())
    assert not again.positions.requires_grad
    assert torch.allclose(again.positions, end.positions, atol=1e-6)


@pytest.mark.gpu
def test_a_gpu_gives_the_same_states_and_gradients(lattice):
    results = []
    for device in ("cpu", "cuda"):
        _, state, log_young = scene(lattice)
        x = state.positions
        particles = Particles.create(x.to(device), grid=GRID, density=1.0, pinned=(x[:, 0] < 1.15).to(device))
        solver = MPMSolver(particles, ELASTIC, GRID, TimeStep(FRAME_TIME, SUBSTEPS))
        v = state.velocities.to(device).requires_grad_()
        E = log_young.to(device).exp().requires_grad_()
        rest = [t.to(device) for t in state.tensors()]
        end = solver.advance(ParticleState(rest[0], v, *rest[2:]), 0, young_modulus=E)
        (end.positions**2).sum().backward()
        results.append([t.detach().cpu() for t in (*end.tensors(), v.grad, E.grad)])
    for one, other in zip(*results, strict=True):
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-3 * float(one.abs().max()))
