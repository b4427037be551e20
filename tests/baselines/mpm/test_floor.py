"""Gravity and a floor: fall, friction, rest, bounce, and loss gradients through a contact."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")

from gausim.baselines.mpm import Grid, Material, MPMSolver, Particles, ParticleState, Slope, TimeStep

SOFT = Material(young_modulus=20.0, poisson_ratio=0.3, density=1.0)
FLOOR, GRAVITY = 0.25, 1.0


def made(x, *, friction=0.3, floor=True):
    slope = Slope((0.0, 0.0, 1.0), FLOOR, friction) if floor else None
    grid = Grid(cells=16, size=1.0, gravity=(0.0, 0.0, -GRAVITY), slope=slope)
    return MPMSolver(Particles.create(x, grid=grid, density=SOFT.density), SOFT, grid, TimeStep(0.05))


def rolled(solver, x, velocity, frames):
    states = [ParticleState.at_rest(x, torch.tensor(velocity).repeat(len(x), 1))]
    for frame in range(frames):
        states.append(solver.advance(states[-1], frame))
    return states


def test_centre_falls_on_the_parabola(lattice):
    x = lattice((0.4, 0.4, 0.6), (0.6, 0.6, 0.75), 1 / 32)
    states = rolled(made(x), x, [0.1, 0.0, 0.0], 10)
    fallen = torch.stack([s.positions.mean(0) for s in states]) - x.mean(0)
    t = 0.05 * torch.arange(11)
    assert fallen[:, 0].tolist() == pytest.approx((0.1 * t).tolist(), abs=1e-4)
    assert fallen[:, 2].tolist() == pytest.approx((-0.5 * GRAVITY * t**2).tolist(), rel=0.02, abs=5e-4)


def test_block_bounces_off_the_floor_and_does_not_enter_it(lattice):
    x = lattice((0.4, 0.4, 0.45), (0.6, 0.6, 0.6), 1 / 32)
    states = rolled(made(x), x, [0.0, 0.0, 0.0], 24)
    height = torch.stack([s.positions[:, 2].mean() for s in states])
    low = torch.stack([s.positions[:, 2].min() for s in states])
    assert low.min() > FLOOR - 0.2 / 16
    bottom = int(height.argmin())
    assert 8 < bottom < 20 and height[bottom:].max() > height[bottom] + 0.02


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_sliding_block_is_slowed_by_friction_times_gravity(lattice, friction):
    x = lattice((0.2, 0.4, FLOOR + 0.015), (0.4, 0.6, FLOOR + 0.14), 1 / 32)
    states = rolled(made(x, friction=friction), x, [0.6, 0.0, 0.0], 16)
    speed = [float(s.velocities[:, 0].mean()) for s in states]
    assert speed[16] - speed[4] == pytest.approx(-friction * GRAVITY * 0.05 * 12, rel=0.1, abs=1e-3)


def test_loss_gradients_pass_through_the_contact(lattice):
    x = lattice((0.4, 0.4, FLOOR + 0.02), (0.55, 0.55, FLOOR + 0.15), 1 / 32)
    solver = made(x)

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
