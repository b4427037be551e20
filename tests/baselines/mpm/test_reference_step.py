"""The compiled solver against a step written once more, plainly, in NumPy and float64."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")

from gausim.baselines.mpm import Grid, Material, MPMSolver, Particles, ParticleState, TimeStep

GRID = Grid(cells=24, size=2.4, damping=1.5)
STEPS, DT = 3, 0.004


def spline(distance: float) -> float:
    """Quadratic B-spline of a distance in cells."""
    d = abs(distance)
    return 0.75 - d * d if d < 0.5 else 0.5 * (1.5 - d) ** 2 if d < 1.5 else 0.0


def stress(material: Material, F: np.ndarray, E: float) -> np.ndarray:
    nu = material.poisson_ratio
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    u, _, vt = np.linalg.svd(F)
    J = np.linalg.det(F)
    return 2 * mu * (F - u @ vt) @ F.T + lam * J * (J - 1) * np.eye(3)


def step(x, v, C, F, m, V, E, held, pinned, material):  # all float64
    n, dx = GRID.cells + 1, GRID.dx
    mass, momentum = np.zeros((n, n, n)), np.zeros((n, n, n, 3))

    def nodes(p):
        near = [range(int(c / dx) - 1, int(c / dx) + 3) for c in x[p]]
        for node in itertools.product(*near):
            offset = np.array(node) * dx - x[p]
            if (np.abs(offset) < 1.5 * dx).all():
                yield node, np.prod([spline(o / dx) for o in offset]), offset

    for p in range(len(x)):
        affine = m[p] * C[p] - DT * V[p] * 4 / dx**2 * stress(material, F[p], E[p])
        for node, weight, offset in nodes(p):
            mass[node] += weight * m[p]
            momentum[node] += weight * (m[p] * v[p] + affine @ offset)
    velocity = np.zeros_like(momentum)
    full = mass >= 1e-15
    velocity[full] = momentum[full] / mass[full][:, None] * (1 - GRID.damping * DT)
    velocity[pinned] = 0
    moved, v, C, F = x.copy(), np.zeros_like(v), np.zeros_like(C), F.copy()
    for p in range(len(x)):
        gathered = list(nodes(p))
        v[p] = sum((w * velocity[node] for node, w, _ in gathered), np.zeros(3))
        C[p] = sum((4 / dx**2 * w * np.outer(velocity[node], o) for node, w, o in gathered), np.zeros((3, 3)))
        F[p] = (np.eye(3) + DT * C[p]) @ F[p]
        moved[p] = x[p] + DT * v[p] * (not held[p])
    return moved, v, C, F


def test_three_substeps_agree_with_the_reference():
    rng = np.random.default_rng(0)
    N = 40
    x = rng.uniform(1.1, 1.5, (N, 3))
    held = x[:, 0] < 1.16
    v, C = rng.standard_normal((N, 3)), 2 * rng.standard_normal((N, 3, 3))
    F = np.eye(3) + 0.1 * rng.standard_normal((N, 3, 3))
    E = np.exp(rng.uniform(5, 7, N))
    material = Material(young_modulus=300.0, poisson_ratio=0.3, density=100.0)

    def tensor(a: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(a).float()

    particles = Particles.create(tensor(x), grid=GRID, density=material.density, pinned=torch.from_numpy(held))
    assert 2 < held.sum() < N / 2
    solver = MPMSolver(particles, material, GRID, TimeStep(STEPS * DT, STEPS, 1.0))
    start = ParticleState(tensor(x), tensor(v), tensor(C), tensor(F))
    end = solver.advance(start, 0, young_modulus=tensor(E))
    m, V = particles.mass.double().numpy(), particles.volume.double().numpy()
    reference = (x, v, C, F)
    for _ in range(STEPS):
        reference = step(*reference, m, V, E, held, particles.pinned_nodes.numpy(), material)
    for name, found, true in zip("xvCF", end.tensors(), reference, strict=True):
        error = np.abs(found.numpy() - true).max() / np.abs(true).max()
        assert error < 1e-4, name
    assert np.abs(reference[0] - x).max() > 2e-3  # something happened
