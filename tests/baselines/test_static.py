from __future__ import annotations

import torch

from gausim.baselines.static import StaticDynamics
from gausim.core import Dynamics, GaussianScene, SimState


def scene(count: int = 5) -> GaussianScene:
    generator = torch.Generator().manual_seed(0)
    return GaussianScene.create(
        means=torch.randn(count, 3, generator=generator),
        log_scales=torch.full((count, 3), -2.0),
        quats=torch.randn(count, 4, generator=generator),
        opacity_logits=torch.zeros(count),
        sh=torch.zeros(count, 4, 3),
    )


def test_static_repeats_the_rest_state_whatever_the_start():
    rest = scene()
    dynamics = StaticDynamics(rest, fps=25.0)
    assert isinstance(dynamics, Dynamics)
    trajectory = dynamics.rollout(SimState(rest.means + 1, rest.means - 1), 6)
    assert trajectory.frames == 7 and trajectory.fps == 25.0
    assert all(torch.equal(frame, rest.means) for frame in trajectory.positions)
    assert torch.equal(trajectory.deformation_gradients[:, 0], torch.eye(3).expand(7, 3, 3))
    points = torch.randn(4, 3)
    carried = trajectory.carry(points, torch.tensor([0, 2, 4, 1]), rest.means)
    assert torch.allclose(carried, points.expand(7, 4, 3), atol=1e-6)
