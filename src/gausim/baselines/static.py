"""The static prediction: nothing moves. Every table compares with it."""

from __future__ import annotations

import torch
from torch import Tensor

from gausim.core import Forces, GaussianScene, SimState, Trajectory


class StaticDynamics:
    """The rest state in every frame, for any initial state and forces.

    Args:
        scene: the rest scene.
        fps: frames per second of the trajectory.
    """

    def __init__(self, scene: GaussianScene, *, fps: float) -> None:
        self.rest: Tensor = scene.means
        self.fps = fps

    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """``steps`` + 1 identical frames of the rest state (memory of one frame)."""
        frames = steps + 1
        identity = torch.eye(3, dtype=self.rest.dtype, device=self.rest.device).expand(frames, 1, 3, 3)
        return Trajectory(
            positions=self.rest.expand(frames, -1, -1),
            deformation_gradients=identity,
            rotations=identity,
            unit_of_kernel=torch.zeros(len(self.rest), dtype=torch.long, device=self.rest.device),
            fps=self.fps,
        )
