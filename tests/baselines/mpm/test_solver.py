"""Conservation, analytic motions, pins and errors of the solver."""

from __future__ import annotations

import math

import pytest
import torch

pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")

from gausim.baselines.mpm import (  # noqa: E402
    Grid,
    Material,
    MPMSolver,
    Particles,
    ParticleState,
    TimeStep,
)
from gausim.core import ConfigError, DivergenceError  # noqa: E402

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


def test_free_fall_follows_the_parabola_and_deforms_nothing(lattice):
    grid = Grid(cells=16, size=1.0, gravity=(0.0, 0.5, -2.0))
    x = lattice((0.35, 0.3, 0.5), (0.6, 0.5, 0.7), 1 / 32)
    v = torch.tensor([0.3, -0.1, 0.4]).repeat(len(x), 1)
    frames, frame_time, substeps = 4, 0.05, 256
    solver = simulation(x, grid, frame_time=frame_time, substeps=substeps)
    state = ParticleState.at_rest(x, v)
    for frame in range(frames):
        state = solver.advance(state, frame)
    t, dt = frames * frame_time, frame_time / substeps
    g = torch.tensor(grid.gravity, dtype=torch.float64)
    moved = state.positions.double().mean(0) - x.double().mean(0)
    error = (moved - (v[0].double() * t + 0.5 * g * t * t)).abs().max()
    discrete = (moved - (v[0].double() * t + 0.5 * g * t * (t + dt))).abs().max()
    print(f"centre of mass: {error:.1e} off the parabola, {discrete:.1e} off the explicit scheme's own")
    assert error < 1e-4 and discrete < 2e-5 and moved.abs().max() > 0.03
    assert (state.deformation_gradients - torch.eye(3)).abs().max() < 1e-4


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
    print(f"relative change of momentum {relative[0]:.1e}, angular momentum {relative[1]:.1e}")
    assert relative[0] < 1e-4 and relative[1] < 1e-3
    assert (state.deformation_gradients - torch.eye(3)).abs().max() > 0.1  # it deformed a lot meanwhile


def quarter_crossings(values: list[float], frame_time: float) -> list[float]:
    """Times at which a sampled curve changes its sign, by linear interpolation."""
    pairs = enumerate(zip(values[:-1], values[1:], strict=True))
    return [(n + a / (a - b)) * frame_time for n, (a, b) in pairs if a * b < 0]


@pytest.mark.parametrize("clamped", [False, True], ids=["free", "clamped"])
def test_axial_period_of_an_elastic_bar(lattice, clamped: bool):
    """A free bar swings with T = 2 L / c, one that is held at an end with 4 L / c; c = sqrt(E / rho)."""
    grid = Grid(cells=32, size=1.0)
    length, start = 0.625, 0.1875  # the bar begins and ends at nodes
    x = lattice((start, 0.4375, 0.4375), (start + length, 0.5625, 0.5625), 1 / 64)
    material = Material(young_modulus=1.0, poisson_ratio=0.3, density=1.0)
    reach = length
    pinned = None
    if clamped:
        pinned = x[:, 0] < start + 0.0625
        reach = length - 0.0625
    s = (x[:, 0] - (start + length - reach)) / reach
    shape = torch.sin(math.pi / 2 * s.clamp_min(0)) if clamped else torch.cos(math.pi * s)
    period = (4 if clamped else 2) * reach / 1.0
    frame_time = period / 40
    solver = simulation(x, grid, material=material, frame_time=frame_time, pinned=pinned)
    v = torch.zeros_like(x)
    v[:, 0] = 0.01 * shape
    state = ParticleState.at_rest(x, v)
    swing = [1.0]
    for frame in range(42):
        state = solver.advance(state, frame)
        swing.append(float((state.velocities[:, 0] * shape).sum()))
    crossings = quarter_crossings(swing, frame_time)
    found = 2 * (crossings[1] - crossings[0])
    print(f"{'clamped' if clamped else 'free'}: period {found:.4f}, analytic {period:.4f} ({found / period - 1:+.1%})")
    assert found == pytest.approx(period, rel=0.05)


def bending_period(lattice, cells: int) -> float:
    """First period of a clamped beam of length 0.5 and square section of edge 0.125, E = rho = 1."""
    grid = Grid(cells=cells, size=1.0)
    x = lattice((0.1875, 0.4375, 0.4375), (0.75, 0.5625, 0.5625), 0.5 / cells)
    material = Material(young_modulus=1.0, poisson_ratio=0.3, density=1.0)
    solver = simulation(x, grid, material=material, frame_time=0.2, pinned=x[:, 0] < 0.25)
    v = torch.zeros_like(x)
    v[:, 2] = 0.002 * ((x[:, 0] - 0.25).clamp_min(0) / 0.5) ** 2
    state = ParticleState.at_rest(x, v)
    tip = x[:, 0] > 0.7
    swing = [1.0]
    while sum(a * b < 0 for a, b in zip(swing[:-1], swing[1:], strict=True)) < 2:
        state = solver.advance(state, len(swing) - 1)
        swing.append(float((state.positions - x)[tip, 2].mean()))
    crossings = quarter_crossings(swing[1:], 0.2)  # from above, then from below
    return 2 * (crossings[1] - crossings[0])


@pytest.mark.slow
def test_bending_period_of_a_clamped_beam(lattice):
    """Bending (Euler) and shear in series (Dunkerley): 1 / w^2 = 1 / w_b^2 + 1 / w_s^2."""
    bending = 1.8751**2 * 0.125 / math.sqrt(12) / 0.5**2
    shear = math.pi / (2 * 0.5) * math.sqrt(0.85 / 2.6)
    analytic = 2 * math.pi * math.sqrt(1 / bending**2 + 1 / shear**2)
    coarse, fine = bending_period(lattice, 32), bending_period(lattice, 48)
    print(f"period {coarse:.3f} on 4 cells across, {fine:.3f} on 6, analytic {analytic:.3f}")
    assert fine == pytest.approx(analytic, rel=0.05)
    assert abs(fine / analytic - 1) < abs(coarse / analytic - 1) < 0.1


def test_pinned_particles_stay_and_the_rest_swings(lattice):
    grid = Grid(cells=16, size=1.0, gravity=(0.0, 0.0, -2.0))
    x = lattice((0.2, 0.4, 0.5), (0.7, 0.55, 0.6), 1 / 32)
    pinned = x[:, 0] < 0.3
    firm = Material(young_modulus=200.0, poisson_ratio=0.3, density=1.0)
    solver = simulation(x, grid, material=firm, pinned=pinned, frame_time=0.05)
    state = ParticleState.at_rest(x)
    for frame in range(6):
        state = solver.advance(state, frame)
    assert torch.equal(state.positions[pinned], x[pinned])
    drop = x[:, 2] - state.positions[:, 2]
    assert drop[x[:, 0] > 0.65].mean() > 0.02
    joint = (x[:, 0] > 0.3) & (x[:, 0] < 0.34)
    assert drop[joint].abs().mean() < 0.1 * drop[x[:, 0] > 0.65].mean()


def test_forces_accelerate(lattice):
    grid = Grid(cells=16, size=1.0)
    x = lattice((0.3, 0.4, 0.4), (0.6, 0.55, 0.55), 1 / 32)
    solver = simulation(x, grid)
    a = torch.tensor([0.0, 0.0, 1.5]).repeat(len(x), 1)
    state = solver.advance(ParticleState.at_rest(x), 0, acceleration=a)
    assert torch.allclose(state.velocities, 0.02 * a, atol=1e-5)


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
    grid = Grid(cells=32, size=1.0)
    x = lattice((0.1, 0.4, 0.4), (0.2, 0.5, 0.5), 1 / 64)
    solver = simulation(x, grid, frame_time=0.5)
    v = torch.tensor([1.0, 0.5, 0.0]).repeat(len(x), 1).requires_grad_()
    end = solver.advance(ParticleState.at_rest(x, v), 0)
    assert torch.allclose(end.positions, x + 0.5 * v, atol=1e-4)  # 16 cells
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


@pytest.mark.parametrize("arguments", [{"poisson_ratio": 0.5}, {"young_modulus": 0.0}, {"density": -1.0}])
def test_impossible_materials_are_refused(arguments):
    with pytest.raises(ConfigError, match=next(iter(arguments))):
        Material(**arguments)
