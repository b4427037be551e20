"""Gradients of two frames against finite differences of the same frames."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")

from gausim.baselines.mpm import Grid, Material, MPMSolver, Particles, ParticleState, TimeStep

# The block's window of nodes begins beside the origin and ends before the border.
GRID = Grid(cells=24, size=2.4, damping=0.5)
ELASTIC = Material(young_modulus=30.0, poisson_ratio=0.3, density=1.0)
STEP = TimeStep(0.03, 10)


def scene(lattice, device: str = "cpu") -> tuple[MPMSolver, ParticleState, Tensor]:
    """A strained, moving block, one of its sides pinned; 36 particles of different moduli."""
    generator = torch.Generator().manual_seed(0)
    x = lattice((1.1, 1.2, 1.1), (1.3, 1.35, 1.25), 1 / 20)
    x = x + 0.01 * torch.rand(x.shape, generator=generator)
    particles = Particles.create(x.to(device), grid=GRID, density=1.0, pinned=(x[:, 0] < 1.15).to(device))

    def noise(*shape: int) -> Tensor:
        return torch.randn(len(x), *shape, generator=generator)

    state = ParticleState(x, 0.5 * noise(3), noise(3, 3), torch.eye(3) + 0.05 * noise(3, 3))
    log_young = torch.log(torch.tensor(ELASTIC.young_modulus)) + 0.3 * noise()
    state = ParticleState(*(t.to(device) for t in state.tensors()))
    return MPMSolver(particles, ELASTIC, GRID, STEP), state, log_young.to(device)


def loss_of(solver: MPMSolver, state: ParticleState, log_young: Tensor) -> Tensor:
    """A smooth number in which every part of the state after two frames counts; float64 sums."""
    for frame in range(2):
        state = solver.advance(state, frame, young_modulus=log_young.exp())
    generator = torch.Generator().manual_seed(7)
    total = torch.zeros((), dtype=torch.float64)
    for value, weight in zip(state.tensors(), (10.0, 1.0, 0.02, 1.0), strict=True):
        total = total + weight * (torch.randn(value.shape, generator=generator).double() * value.double()).sum()
    return total


STEPS = {"positions": 1e-4, "velocities": 1e-2, "affine": 1e-1, "deformation_gradients": 1e-3, "log_young": 2e-2}


@pytest.mark.parametrize("name", STEPS)
def test_gradients_are_difference_quotients(lattice, name: str):
    solver, state, log_young = scene(lattice)
    at, step = log_young if name == "log_young" else getattr(state, name), STEPS[name]

    def function(value: Tensor) -> Tensor:
        if name == "log_young":
            return loss_of(solver, state, value)
        return loss_of(solver, replace(state, **{name: value}), log_young)

    variable = at.clone().requires_grad_()
    function(variable).backward()
    generator = torch.Generator().manual_seed(3)
    directions = [torch.randn(at.shape, generator=generator) for _ in range(4)]
    with torch.no_grad():
        true = torch.stack([(function(at + step * d) - function(at - step * d)) / (2 * step) for d in directions])
    found = torch.stack([(variable.grad.double() * d.double()).sum() for d in directions])
    assert float((found - true).norm() / true.norm()) < 1e-2


@pytest.mark.gpu
def test_a_gpu_gives_the_same_states_and_gradients(lattice):
    results = []
    for device in ("cpu", "cuda"):
        solver, state, log_young = scene(lattice, device)
        leaves = [t.requires_grad_() for t in (*state.tensors(), log_young)]
        made = ParticleState(*leaves[: len(fields(state))])
        end = solver.advance(made, 0, young_modulus=leaves[-1].exp())
        grads = torch.autograd.grad((end.positions**2).sum(), leaves, allow_unused=True)
        results.append([t.detach().cpu() for t in (*end.tensors(), *(g for g in grads if g is not None))])
    for one, other in zip(*results, strict=True):
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-3 * float(one.abs().max()))
