"""Cameras around an object, and images of its states by the compiled renderer."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from data_prep.common.spread import dome
from data_prep.synthetic.bodies import Array
from gausim.core import Cameras, GaussianScene
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import draw, to_bytes

FIELD_OF_VIEW = math.radians(40.0)
MARGIN = 1.0  # the sphere around the bounding box overstates the object; what is left is room for its motion
# Azimuth and elevation [degree] of the five video cameras; the last one is never trained on.
VIDEO_ANGLES = ((-60.0, 18.0), (30.0, 18.0), (120.0, 18.0), (210.0, 40.0), (75.0, 30.0))


def look_at(
    azimuth: Array, elevation: Array, center: Array, radius: float, size: tuple[int, ...], names: tuple[str, ...]
) -> Cameras:
    """Cameras on a sphere [radian] that look at ``center`` with z up; the bounding sphere fills the shorter side."""
    distance = MARGIN * radius / math.sin(FIELD_OF_VIEW / 2)
    back = np.stack((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), -1)
    right = np.stack((-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)), -1)
    rotation = np.stack((right, -np.cross(back, right), -back), 1)  # rows: x right, y down, z forward
    viewmats = np.tile(np.eye(4), (len(azimuth), 1, 1))
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3] = -np.einsum("vij,vj->vi", rotation, center + distance * back)
    width, height = size[0], size[-1]
    focal = min(size) / (2 * math.tan(FIELD_OF_VIEW / 2))
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    intrinsics = intrinsics.expand(len(azimuth), 3, 3).clone()
    return Cameras(torch.from_numpy(viewmats).float(), intrinsics, width, height, names)


def video_cameras(center: Array, radius: float, size: tuple[int, ...], names: tuple[str, ...]) -> Cameras:
    """The first ``len(names) - 1`` training cameras and the held-out one."""
    angles = np.radians([*VIDEO_ANGLES[: len(names) - 1], VIDEO_ANGLES[-1]])
    return look_at(angles[:, 0], angles[:, 1], center, radius, size, names)


def still_cameras(center: Array, radius: float, size: int, count: int) -> Cameras:
    """Cameras spread evenly over the upper dome, from level to 70 degrees up."""
    azimuth, elevation = np.array(dome(count, 70.0)).T
    return look_at(azimuth, elevation, center, radius, (size,), tuple(f"{i:04d}" for i in range(count)))


def photograph(
    scene: GaussianScene, positions: Array, gradients: Array, cameras: Cameras
) -> UInt8[Tensor, "F V H W 4"]:
    """Straight-alpha RGBA of F states of a scene.

    Args:
        scene: K kernels at rest.
        positions: (F, K, 3) kernel means [scene units].
        gradients: (F, K, 3, 3) deformation gradient at each kernel.
        cameras: V views.
    """
    u, _, vt = np.linalg.svd(gradients)
    with torch.inference_mode():
        means, deformed, turned = (torch.from_numpy(part).float() for part in (positions, gradients, u @ vt))
        drawn = draw(CpuRenderer(), scene, means, deformed, turned, torch.arange(scene.count), cameras)
        alpha = drawn.alpha.clamp(0, 1)[..., None]
        rgb = torch.where(alpha > 0.5 / 255, drawn.rgb / alpha.clamp_min(0.5 / 255), 0.0)
        return to_bytes(torch.cat((rgb, alpha), -1))
