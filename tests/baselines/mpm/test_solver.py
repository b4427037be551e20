"""Conservation, analytic motions, pins, contact with a floor and errors of the solver."""

from __future__ import annotations

import math

import pytest
import torch

pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")

from gausim.baselines.mpm import Grid, Material, MPMSolver, Particles, ParticleState, Slope, TimeStep
from gausim.core import ConfigError, DivergenceError

FLOOR, GRAVITY = 0.25, 1.0
SOFT = Material(young_modulus=20.0, poisson_ratio=0.3, density=1.0)


def simulation(x, grid, *, material=SOFT, frame_time=0.02, substeps=None, pinned=None):
    particles = Particles.create(x, grid=grid, density=material.density, pinned=pinned)
    return MPMSolver(particles, material, grid, TimeStep(frame_time, substeps))


def momenta(state: ParticleState, mass: torch.Tensor, dx: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear and angular momentum, with the spin that APIC keeps in C: m dx^2 / 4 axial(C)."""
    x, v, C, m = (t.double() for t in (state.positions, state.velocities, state.affine, mass))
    spin = torch.stack((C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]), -1)
    linear = (m[:, None] * v).sum(0)
    return linear, (m[:, None] * (torch.linalg.cross(x, v) + dx**2 / 4 * spin)).sum(0)


def test_momenta_are_conserved_without_boundary(lattice):
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


def test_axial_period_of_a_bar_held_at_one_end(lattice):
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
        state = solver.advance(state, frame)
        swing.append(float((state.velocities[:, 0] * shape).sum()))
    pairs = enumerate(zip(swing[:-1], swing[1:], strict=True))
    crossings = [(n + a / (a - b)) * period / 40 for n, (a, b) in pairs if a * b < 0]
    assert 2 * (crossings[1] - crossings[0]) == pytest.approx(period, rel=0.05)


def test_leaving_the_domain_names_particle_place_frame_and_remedy(lattice):
    grid = Grid(cells=16, size=1.0)
    x = lattice((0.7, 0.4, 0.4), (0.9, 0.5, 0.5), 1 / 32)
    v = torch.tensor([1.0, 0.0, 0.0]).repeat(len(x), 1)
    solver = simulation(x, grid)
    state = ParticleState.at_rest(x, v)
    with pytest.raises(DivergenceError, match=r"frame \d+: particle \d+ is at \(0\.97.*Enlarge the domain"):
        for frame in range(20):
            state = solver.advance(state, frame)
    broken = ParticleState.at_rest(x, torch.full_like(v, float("nan")))
    with pytest.raises(DivergenceError, match=r"frame 1: particle 0 is at \(nan.*take more substeps"):
        solver.advance(broken, 0)
    with pytest.raises(DivergenceError, match=r"at rest: particle 0 is at \(-0\.284"):
        Particles.create(x - 1, grid=grid, density=1.0)


def test_a_frame_may_carry_particles_far_beyond_the_nodes_where_it_began(lattice):
    grid = Grid(cells=20, size=1.0)
    x = lattice((0.1, 0.4, 0.4), (0.2, 0.5, 0.5), 1 / 40)
    solver = simulation(x, grid, frame_time=0.5)
    v = torch.tensor([1.0, 0.5, 0.0]).repeat(len(x), 1).requires_grad_()
    end = solver.advance(ParticleState.at_rest(x, v), 0)
    assert torch.allclose(end.positions, x + 0.5 * v, atol=1e-4)  # 10 cells
    end.positions[:, 0].sum().backward()
    assert float(v.grad[:, 0].sum()) == pytest.approx(0.5 * len(x), rel=1e-3)


def test_substeps_keep_the_bound_or_are_refused(lattice):
    grid = Grid(cells=64, size=1.0)
    x = lattice((0.4, 0.4, 0.4), (0.6, 0.5, 0.5), 1 / 64)
    stiff = Material(young_modulus=1e6, poisson_ratio=0.3, density=2000.0)
    E = torch.full((len(x),), 1e6)
    solver = simulation(x, grid, material=stiff, frame_time=1 / 30)
    count = solver.substeps(E)
    assert 1 / 30 / count < 0.3 / 64 / math.sqrt(500) <= 1 / 30 / (count - 1)
    assert simulation(x, grid, material=stiff, frame_time=1 / 30, substeps=768).substeps(E) == 768
    given = simulation(x, grid, material=stiff, frame_time=1 / 30, substeps=50)
    with pytest.raises(ConfigError, match=rf"substeps: 50 per frame.*at least {count} substeps"):
        given.advance(ParticleState.at_rest(x), 0)
    E[7] = 4e6  # one stiff particle is enough
    assert solver.substeps(E) in (2 * count, 2 * count - 1)
    with pytest.raises(ConfigError, match="young_modulus: expected positive"):
        solver.substeps(-E)


def test_particles_of_a_cell_share_its_volume():
    x = torch.tensor([[0.51, 0.51, 0.51], [0.58, 0.52, 0.55], [0.65, 0.52, 0.55]])
    volume = Particles.create(x, grid=Grid(cells=10, size=1.0), density=1.0).volume
    assert torch.allclose(volume, torch.tensor([0.5, 0.5, 1.0]) * 1e-3)


def above_floor(x, friction=0.3):
    slope = Slope((0.0, 0.0, 1.0), FLOOR, friction)
    return simulation(x, Grid(cells=16, size=1.0, gravity=(0.0, 0.0, -GRAVITY), slope=slope), frame_time=0.05)


def rolled(solver, x, velocity, frames):
    states = [ParticleState.at_rest(x, torch.tensor(velocity).repeat(len(x), 1))]
    for frame in range(frames):
        states.append(solver.advance(states[-1], frame))
    return states


def test_centre_falls_on_the_parabola(lattice):
    x = lattice((0.4, 0.4, 0.6), (0.6, 0.6, 0.75), 1 / 32)
    states = rolled(above_floor(x), x, [0.1, 0.0, 0.0], 10)
    fallen = torch.stack([s.positions.mean(0) for s in states]) - x.mean(0)
    t = 0.05 * torch.arange(11)
    assert fallen[:, 0].tolist() == pytest.approx((0.1 * t).tolist(), abs=1e-4)
    assert fallen[:, 2].tolist() == pytest.approx((-0.5 * GRAVITY * t**2).tolist(), rel=0.02, abs=5e-4)


def test_block_bounces_off_the_floor_and_does_not_enter_it(lattice):
    x = lattice((0.4, 0.4, 0.45), (0.6, 0.6, 0.6), 1 / 32)
    states = rolled(above_floor(x), x, [0.0, 0.0, 0.0], 24)
    height = torch.stack([s.positions[:, 2].mean() for s in states])
    low = torch.stack([s.positions[:, 2].min() for s in states])
    assert low.min() > FLOOR - 0.2 / 16
    bottom = int(height.argmin())
    assert 8 < bottom < 20 and height[bottom:].max() > height[bottom] + 0.02


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_sliding_block_is_slowed_by_friction_times_gravity(lattice, friction):
    x = lattice((0.2, 0.4, FLOOR + 0.015), (0.4, 0.6, FLOOR + 0.14), 1 / 32)
    states = rolled(above_floor(x, friction), x, [0.6, 0.0, 0.0], 16)
    speed = [float(s.velocities[:, 0].mean()) for s in states]
    assert speed[16] - speed[4] == pytest.approx(-friction * GRAVITY * 0.05 * 12, rel=0.1, abs=1e-3)


def test_loss_gradients_pass_through_the_contact(lattice):
    x = lattice((0.4, 0.4, FLOOR + 0.02), (0.55, 0.55, FLOOR + 0.15), 1 / 32)
    solver = above_floor(x)

    def end(speed):
        v = torch.cat((torch.full((2,), 0.1), speed[None])).expand(len(x), 3)
        state = ParticleState.at_rest(x, v)
        for frame in range(3):
            state = solver.advance(state, frame)
        return state.positions[:, 2].mean()

    speed = torch.tensor(-0.5, requires_grad=True)
    end(speed).backward()
    with torch.no_grad():
        step = torch.tensor(1e-2)
        numeric = (end(speed + step) - end(speed - step)) / (2 * step)
    assert float(speed.grad) == pytest.approx(float(numeric), rel=0.03)
    assert abs(float(numeric)) < 0.9 * 0.15, "the floor had no effect"
