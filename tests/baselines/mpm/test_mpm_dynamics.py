"""A scene of Gaussians rolled out by the material point method."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest
import torch

pytest.importorskip("warp", reason="the material point method needs warp-lang (extra 'baselines')")

from gausim.baselines.mpm import Conditions, Filling, Grid, Impulse, Material, MPMDynamics  # noqa: E402
from gausim.baselines.mpm.dynamics import rotations  # noqa: E402
from gausim.core import Dynamics, GaussianScene, SimState  # noqa: E402
from gausim.ops.covariance import kernel_volumes  # noqa: E402

GRID = Grid(cells=23, size=2.0)  # the pole's kernels lie on no border of cells
SOFT = Material(young_modulus=50.0, poisson_ratio=0.3, density=1.0)


@pytest.fixture
def pole(lattice) -> GaussianScene:
    """A pole in a scene of its own units and place: its foot is pinned, two kernels beside it are not simulated."""
    body = lattice((10.0, 20.0, 5.0), (11.0, 21.0, 9.0), 0.25)
    means = torch.cat((torch.tensor([[9.0, 9.0, 9.0], [1.0, 2.0, 3.0]]), body))
    count = len(means)
    simulated = torch.arange(count) >= 2
    return GaussianScene.create(
        means=means,
        log_scales=torch.full((count, 3), -2.0),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacity_logits=torch.full((count,), 3.0),
        sh=torch.zeros(count, 1, 3),
        simulated=simulated,
        pinned=simulated & (means[:, 2] < 5.75),
    )


def pushed(scene: GaussianScene, velocity: float, fps: float) -> SimState:
    """The top moves along x with this velocity."""
    free = scene.simulated & ~scene.pinned
    move = torch.zeros_like(scene.means)
    move[free, 0] = velocity / fps * (scene.means[free, 2] - 5.75) / 3.25
    return SimState(scene.means, scene.means - move)


def test_rollout_is_a_trajectory_that_starts_at_the_initial_state(pole):
    dynamics = MPMDynamics(pole, fps=24.0, material=SOFT, grid=GRID)
    assert isinstance(dynamics, Dynamics)
    start = pushed(pole, 2.0, 24.0)
    trajectory = dynamics.rollout(start, 6)
    assert trajectory.frames == 7 and trajectory.fps == 24.0
    assert torch.equal(trajectory.positions[0], pole.means)
    assert torch.equal(trajectory.deformation_gradients[0], torch.eye(3).expand_as(trajectory.deformation_gradients[0]))
    still = pole.pinned | ~pole.simulated
    assert torch.equal(trajectory.positions[:, still], pole.means[still].expand(7, -1, -1))
    carried = trajectory.deformation_gradients[:, trajectory.unit_of_kernel[still]]
    assert torch.equal(carried, torch.eye(3).expand_as(carried))
    top = pole.means[:, 2] > 8.7
    first = (trajectory.positions[1] - trajectory.positions[0])[top & pole.simulated]
    assert first[:, 0].mean() == pytest.approx(2.0 / 24, rel=0.15)  # it begins to spring back
    assert float(torch.det(trajectory.rotations).min()) > 0.999
    assert not trajectory.positions.requires_grad
    bent = trajectory.rotations[3][trajectory.unit_of_kernel[top & pole.simulated]]
    assert float(bent[:, 0, 2].mean()) > 0.01  # it leans the way it was pushed


def test_place_and_scale_of_the_scene_do_not_matter(pole):
    fps = 24.0
    first = MPMDynamics(pole, fps=fps, material=SOFT, grid=GRID).rollout(pushed(pole, 2.0, fps), 4)
    other = replace(pole, means=0.1 * pole.means - 3)
    start = pushed(pole, 2.0, fps)
    state = SimState(0.1 * start.positions - 3, 0.1 * start.previous - 3)
    second = MPMDynamics(other, fps=fps, material=SOFT, grid=GRID).rollout(state, 4)
    moved = (first.positions - first.positions[0]).abs().max()
    assert (10 * (second.positions + 3) - first.positions).abs().max() < 2e-3 * moved
    assert (second.deformation_gradients - first.deformation_gradients).abs().max() < 1e-3


def test_forces_and_impulses_are_in_units_of_the_scene(pole):
    fps = 24.0
    loose = replace(pole, pinned=torch.zeros_like(pole.pinned))
    rest = SimState(pole.means, pole.means)
    volume = kernel_volumes(pole.log_scales, pole.volume_scale)  # the mass of kernels of unit density

    def push(frame: int) -> torch.Tensor | None:
        return torch.tensor([0.0, 3.0, 0.0]) * volume[:, None] if frame == 0 else None

    dynamics = MPMDynamics(loose, fps=fps, material=SOFT, grid=GRID)
    moved = dynamics.rollout(rest, 2, forces=push).positions[:, 2:].mean(1)
    assert float((moved[2] - moved[1])[1]) == pytest.approx(3.0 / fps**2, rel=1e-3)
    impulse = Conditions(impulses=(Impulse(None, (0.0, 0.0, 1.5), frame=1),))
    moved = MPMDynamics(loose, fps=fps, material=SOFT, grid=GRID, conditions=impulse).rollout(rest, 2).positions
    assert torch.allclose(moved[1], pole.means, atol=1e-5)
    assert torch.allclose((moved[2] - moved[1])[2:, 2], torch.tensor(1.5 / fps), rtol=1e-3)


def test_filling_adds_particles_that_are_not_shown(lattice):
    block = lattice((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.0625)
    shell = block[((block - 0.5).abs() > 0.46).any(1)]
    count = len(shell)
    scene = GaussianScene.create(
        means=shell,
        log_scales=torch.full((count, 3), -3.2),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacity_logits=torch.full((count,), 6.0),
        sh=torch.zeros(count, 1, 3),
        pinned=shell[:, 2] < 0.1,
    )
    options = Filling(cells=32, dense=1e9, wall=0.6, per_cell=2)
    dynamics = MPMDynamics(scene, fps=24.0, material=SOFT, grid=GRID, filling=options)
    start = SimState(shell, shell - torch.tensor([0.01, 0.0, 0.0]))
    state = dynamics.start(start)
    added = len(state.positions) - count
    print(f"{count} kernels, {added} filled particles")
    assert 0.6 * 14**3 * 2 < added * 0.0625**3 / (2 / 32) ** 3 < 1.4 * 14**3 * 2
    free = ~dynamics.solver.particles.pinned[count:]
    velocity = dynamics.mapping.scale * 0.01 * 24.0
    assert float(state.velocities[count:, 0][free].mean()) == pytest.approx(velocity, rel=0.1)
    trajectory = dynamics.rollout(start, 2)
    assert trajectory.positions.shape == (3, count, 3) and trajectory.deformation_gradients.shape == (
        3,
        count + 1,
        3,
        3,
    )


def test_young_modulus_of_kernels_carries_gradients(pole):
    modulus = torch.full((int(pole.simulated.sum()),), 50.0, requires_grad=True)
    dynamics = MPMDynamics(pole, fps=24.0, material=SOFT, grid=GRID).with_young_modulus(modulus)
    state = dynamics.advance(dynamics.start(pushed(pole, 2.0, 24.0)), 0)
    (state.positions**2).sum().backward()
    assert torch.isfinite(modulus.grad).all() and modulus.grad.abs().max() > 0


def test_rotations_of_matter_turned_inside_out_are_rotations():
    generator = torch.Generator().manual_seed(0)
    F = torch.randn(50, 3, 3, generator=generator)
    assert 10 < (torch.det(F) < 0).sum() < 40
    R = rotations(F)
    assert torch.allclose(torch.det(R), torch.ones(50), atol=1e-4)
    assert torch.allclose(R @ R.mT, torch.eye(3).expand(50, 3, 3), atol=1e-4)
    upright = torch.det(F) > 0.05
    u, _, vt = torch.linalg.svd(F[upright])
    assert torch.allclose(R[upright], u @ vt, atol=1e-3)


def test_importing_does_not_load_warp():
    code = "import gausim.baselines.mpm, sys; print('warp' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split()[-1] == "False"


def test_without_warp_the_error_names_the_extra(monkeypatch):
    from gausim.baselines.mpm.runtime import warp
    from gausim.core import ConfigError

    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(ConfigError, match=r"gausim\[baselines\]"):
        warp()
