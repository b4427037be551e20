"""The solver of material points: filling, a step against NumPy, loss gradients, conservation, analytic motions."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from gausim.baselines.mpm import Filling, fill_interior

pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")
from gausim.baselines.mpm import Grid, Material, MPMSolver, Particles, ParticleState, Slope, TimeStep
from gausim.core import ConfigError

DEVIATION, CELL = 0.035, 0.05


def lattice(lower: Sequence[float], upper: Sequence[float], spacing: float) -> Tensor:
    """Positions of a block from one corner to the other, each in the middle of a cube of the given edge."""
    counts = [round((b - a) / spacing) for a, b in zip(lower, upper, strict=True)]
    axes = [a + spacing * (torch.arange(n) + 0.5) for a, n in zip(lower, counts, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def sphere(radius: float, count: int = 3000) -> Tensor:
    """Points on a sphere about (1, 1, 1), evenly (Fibonacci)."""
    n = torch.arange(count) + 0.5
    z, angle = 1 - 2 * n / count, math.pi * (3 - 5**0.5) * n
    flat = (1 - z * z).sqrt()
    return 1 + radius * torch.stack((flat * angle.cos(), flat * angle.sin(), z), -1)


def distances(points: Tensor) -> Tensor:
    """Distances from (1, 1, 1) of the particles that fill round kernels at the points."""
    covars = (DEVIATION**2 * torch.eye(3)).expand(len(points), 3, 3)
    filling = Filling(cells=round(2 / CELL), per_cell=4)
    return (fill_interior(points, covars, torch.ones(len(points)), 2.0, filling) - 1).norm(dim=-1)


def test_a_hollow_sphere_is_filled_inside_and_only_there() -> None:
    found = distances(sphere(0.5))
    assert float(found.max()) < 0.5 + 3 * DEVIATION + CELL  # the shell and what is in it
    core = 4 / 3 * math.pi * 0.4**3
    assert float((found < 0.4).sum()) / 4 * CELL**3 == pytest.approx(core, rel=0.05)
    between = distances(torch.cat((sphere(0.6, 6000), sphere(0.3))))
    assert ((between > 0.4) & (between < 0.5)).any() and not (between < 0.15).any()  # the ray meets two walls there


GRID = Grid(cells=24, size=2.4)
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
    velocity[full] = momentum[full] / mass[full][:, None]
    velocity[pinned] = 0
    moved, v, C, F = x.copy(), np.zeros_like(v), np.zeros_like(C), F.copy()
    for p in range(len(x)):
        gathered = list(nodes(p))
        v[p] = sum((w * velocity[node] for node, w, _ in gathered), np.zeros(3))
        C[p] = sum((4 / dx**2 * w * np.outer(velocity[node], o) for node, w, o in gathered), np.zeros((3, 3)))
        F[p] = (np.eye(3) + DT * C[p]) @ F[p]
        moved[p] = x[p] + DT * v[p] * (not held[p])
    return moved, v, C, F


def test_three_substeps_agree_with_the_reference(monkeypatch):
    rng = np.random.default_rng(0)
    N = 30
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
    solver = MPMSolver(particles, material, GRID, TimeStep(STEPS * DT))
    monkeypatch.setattr(solver, "substeps", lambda young: STEPS)
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


# The block's window of nodes begins beside the origin and ends before the border.
ADJOINT_GRID = Grid(cells=24, size=2.4)
ELASTIC = Material(young_modulus=30.0, poisson_ratio=0.3, density=1.0)


class Solver(MPMSolver):
    """Takes ten substeps, whatever the moduli."""

    def substeps(self, young_modulus: Tensor) -> int:
        return 10


def scene(device: str = "cpu") -> tuple[MPMSolver, ParticleState, Tensor]:
    """A strained, moving block, one of its sides pinned; 36 particles of different moduli."""
    generator = torch.Generator().manual_seed(0)
    x = lattice((1.1, 1.2, 1.1), (1.3, 1.35, 1.25), 1 / 20)
    x = x + 0.01 * torch.rand(x.shape, generator=generator)
    particles = Particles.create(x.to(device), grid=ADJOINT_GRID, density=1.0, pinned=(x[:, 0] < 1.15).to(device))

    def noise(*shape: int) -> Tensor:
        return torch.randn(len(x), *shape, generator=generator)

    state = ParticleState(x, 0.5 * noise(3), noise(3, 3), torch.eye(3) + 0.05 * noise(3, 3))
    log_young = torch.log(torch.tensor(ELASTIC.young_modulus)) + 0.3 * noise()
    state = ParticleState(*(t.to(device) for t in state.tensors()))
    return Solver(particles, ELASTIC, ADJOINT_GRID, TimeStep(0.03)), state, log_young.to(device)


def loss_of(solver: MPMSolver, state: ParticleState, log_young: Tensor) -> Tensor:
    """A smooth number in which every part of the state after two frames counts; float64 sums."""
    for frame in range(2):
        state = solver.advance(state, frame, young_modulus=log_young.exp())
    generator = torch.Generator().manual_seed(7)
    total = torch.zeros((), dtype=torch.float64)
    for value, weight in zip(state.tensors(), (10.0, 1.0, 0.02, 1.0), strict=True):
        total = total + weight * (torch.randn(value.shape, generator=generator).double() * value.double()).sum()
    return total


ADJOINT_STEPS = dict(positions=1e-4, velocities=1e-2, affine=1e-1, deformation_gradients=1e-3, log_young=2e-2)


@pytest.mark.parametrize("name", ADJOINT_STEPS)
def test_gradients_are_difference_quotients(name: str):
    solver, state, log_young = scene()
    at, step = log_young if name == "log_young" else getattr(state, name), ADJOINT_STEPS[name]

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
def test_a_gpu_gives_the_same_states_and_gradients():
    results = []
    for device in ("cpu", "cuda"):
        solver, state, log_young = scene(device)
        leaves = [t.requires_grad_() for t in (*state.tensors(), log_young)]
        made = ParticleState(*leaves[: len(fields(state))])
        end = solver.advance(made, 0, young_modulus=leaves[-1].exp())
        grads = torch.autograd.grad((end.positions**2).sum(), leaves, allow_unused=True)
        results.append([t.detach().cpu() for t in (*end.tensors(), *(g for g in grads if g is not None))])
    for one, other in zip(*results, strict=True):
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-3 * float(one.abs().max()))


FLOOR, GRAVITY = 0.25, 1.0
SOFT = Material(young_modulus=20.0, poisson_ratio=0.3, density=1.0)


def simulation(x, grid, *, material=SOFT, frame_time=0.02, pinned=None):
    pinned = torch.zeros(len(x), dtype=torch.bool) if pinned is None else pinned
    particles = Particles.create(x, grid=grid, density=material.density, pinned=pinned)
    return MPMSolver(particles, material, grid, TimeStep(frame_time))


def advance(solver, state, frame):
    """A frame of the material's own modulus."""
    young = torch.full((len(state.positions),), solver.material.young_modulus)
    return solver.advance(state, frame, young_modulus=young)


def momenta(state: ParticleState, mass: torch.Tensor, dx: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear and angular momentum, with the spin that APIC keeps in C: m dx^2 / 4 axial(C)."""
    x, v, C, m = (t.double() for t in (state.positions, state.velocities, state.affine, mass))
    spin = torch.stack((C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]), -1)
    linear = (m[:, None] * v).sum(0)
    return linear, (m[:, None] * (torch.linalg.cross(x, v) + dx**2 / 4 * spin)).sum(0)


def test_momenta_are_conserved_without_boundary():
    grid = Grid(cells=16, size=1.0)
    x = lattice((0.35, 0.35, 0.4), (0.65, 0.55, 0.6), 1 / 32)
    generator = torch.Generator().manual_seed(0)
    x = x + 0.01 * torch.rand(x.shape, generator=generator)
    spin = torch.linalg.cross(torch.tensor([1.0, 2.0, -1.5]).expand_as(x), x - x.mean(0))
    v = spin + 0.2 * torch.randn(x.shape, generator=generator) + torch.tensor([0.3, 0.1, -0.2])
    E = 40 * torch.exp(torch.rand(len(x), generator=generator))
    solver = simulation(x, grid, frame_time=0.05)
    state = ParticleState.at_rest(x, v)
    before = momenta(state, solver.particles.mass, grid.dx)
    for frame in range(4):
        state = solver.advance(state, frame, young_modulus=E)
    after = momenta(state, solver.particles.mass, grid.dx)
    relative = [float((a - b).norm() / b.norm()) for a, b in zip(after, before, strict=True)]
    assert relative[0] < 1e-4 and relative[1] < 1e-3
    assert (state.deformation_gradients - torch.eye(3)).abs().max() > 0.1  # it deformed a lot meanwhile


def test_axial_period_of_a_bar_held_at_one_end():
    """It swings with T = 4 L / c, c = sqrt(E / rho)."""
    grid = Grid(cells=32, size=1.0)
    start, held, end = 0.1875, 0.25, 0.8125  # nodes
    x = lattice((start, 0.4375, 0.4375), (end, 0.5625, 0.5625), 1 / 64)
    material = Material(young_modulus=1.0, poisson_ratio=0.3, density=1.0)
    shape = torch.sin(math.pi / 2 * ((x[:, 0] - held) / (end - held)).clamp_min(0))
    period = 4 * (end - held)
    solver = simulation(x, grid, material=material, frame_time=period / 40, pinned=x[:, 0] < held)
    state = ParticleState.at_rest(x, 0.01 * shape[:, None] * torch.tensor([1.0, 0.0, 0.0]))
    swing = [1.0]
    for frame in range(32):
        state = advance(solver, state, frame)
        swing.append(float((state.velocities[:, 0] * shape).sum()))
    pairs = enumerate(zip(swing[:-1], swing[1:], strict=True))
    crossings = [(n + a / (a - b)) * period / 40 for n, (a, b) in pairs if a * b < 0]
    assert 2 * (crossings[1] - crossings[0]) == pytest.approx(period, rel=0.05)


def test_a_frame_may_carry_particles_far_beyond_the_nodes_where_it_began():
    grid = Grid(cells=20, size=1.0)
    x = lattice((0.1, 0.4, 0.4), (0.2, 0.5, 0.5), 1 / 40)
    solver = simulation(x, grid, frame_time=0.5)
    v = torch.tensor([1.0, 0.5, 0.0]).repeat(len(x), 1).requires_grad_()
    end = advance(solver, ParticleState.at_rest(x, v), 0)
    assert torch.allclose(end.positions, x + 0.5 * v, atol=1e-4)  # 10 cells
    end.positions[:, 0].sum().backward()
    assert float(v.grad[:, 0].sum()) == pytest.approx(0.5 * len(x), rel=1e-3)


def test_substeps_keep_the_bound_and_particles_of_a_cell_share_its_volume() -> None:
    grid = Grid(cells=64, size=1.0)
    x = lattice((0.4, 0.4, 0.4), (0.6, 0.5, 0.5), 1 / 64)
    stiff = Material(young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
    E = torch.full((len(x),), 1e6)
    solver = simulation(x, grid, material=stiff, frame_time=1 / 30)
    count = solver.substeps(E)
    assert 1 / 30 / count < 0.3 / 64 / math.sqrt(500) <= 1 / 30 / (count - 1)
    E[7] = 4e6  # one stiff particle is enough
    assert solver.substeps(E) in (2 * count, 2 * count - 1)
    with pytest.raises(ConfigError, match="young_modulus: expected positive"):
        solver.substeps(-E)
    x = torch.tensor([[0.51, 0.51, 0.51], [0.58, 0.52, 0.55], [0.65, 0.52, 0.55]])
    volume = simulation(x, Grid(cells=10, size=1.0)).particles.volume
    assert torch.allclose(volume, torch.tensor([0.5, 0.5, 1.0]) * 1e-3)


def above_floor(x, friction=0.3):
    slope = Slope((0.0, 0.0, 1.0), FLOOR, friction)
    return simulation(x, Grid(cells=16, size=1.0, gravity=(0.0, 0.0, -GRAVITY), slope=slope), frame_time=0.05)


def rolled(solver, x, velocity, frames):
    states = [ParticleState.at_rest(x, torch.tensor(velocity).repeat(len(x), 1))]
    for frame in range(frames):
        states.append(advance(solver, states[-1], frame))
    return states


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_sliding_block_is_slowed_by_friction_times_gravity(friction):
    x = lattice((0.2, 0.4, FLOOR + 0.015), (0.4, 0.6, FLOOR + 0.14), 1 / 32)
    states = rolled(above_floor(x, friction), x, [0.6, 0.0, 0.0], 16)
    speed = [float(s.velocities[:, 0].mean()) for s in states]
    assert speed[16] - speed[4] == pytest.approx(-friction * GRAVITY * 0.05 * 12, rel=0.1, abs=1e-3)


def test_loss_gradients_pass_through_the_contact():
    x = lattice((0.4, 0.4, FLOOR + 0.02), (0.55, 0.55, FLOOR + 0.15), 1 / 32)
    solver = above_floor(x)

    def end(speed):
        v = torch.cat((torch.full((2,), 0.1), speed[None])).expand(len(x), 3)
        state = ParticleState.at_rest(x, v)
        for frame in range(3):
            state = advance(solver, state, frame)
        return state.positions[:, 2].mean()

    speed = torch.tensor(-0.5, requires_grad=True)
    end(speed).backward()
    with torch.no_grad():
        step = torch.tensor(1e-2)
        numeric = (end(speed + step) - end(speed - step)) / (2 * step)
    assert float(speed.grad) == pytest.approx(float(numeric), rel=0.03)
    assert abs(float(numeric)) < 0.9 * 0.15, "the floor had no effect"
