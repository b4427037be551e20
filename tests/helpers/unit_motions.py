"""Scenes whose kernels follow units that turn, stretch and move apart."""

from dataclasses import replace

import torch

from gausim.core import GaussianScene, Trajectory
from gausim.ops.deformation import polar_rotation
from helpers.random_scene import random_scene


def unit_scene(count: int = 60, degree: int = 2) -> GaussianScene:
    scene = random_scene(count, degree)
    return replace(scene, pinned=torch.arange(count) < 5, foreground=torch.arange(count) % 7 > 0, volume_scale=3.5)


def unit_motion(scene: GaussianScene, frames: int = 5, units: int = 6, travel: float = 0.0) -> Trajectory:
    """Kernels 0..4 are a unit that stands still, unless all ``travel`` so far per frame [scene units]."""
    torch.manual_seed(1)
    unit = 1 + torch.arange(scene.count) % (units - 1)
    unit[:5] = 0
    gradients = torch.eye(3) + 0.3 * torch.rand(frames, units, 3, 3)
    moved = 0.4 * torch.rand(frames, units, 3) + travel * torch.arange(frames)[:, None, None]
    gradients[:, 0], gradients[0], moved[0] = torch.eye(3), torch.eye(3), 0
    if not travel:
        moved[:, 0] = 0
    centres = torch.stack([scene.means[unit == u].mean(0) for u in range(units)])
    offset = scene.means - centres[unit]
    positions = (centres + moved)[:, unit] + (gradients[:, unit] @ offset[..., None])[..., 0]
    return Trajectory(positions, gradients, polar_rotation(gradients), unit, 30.0)
