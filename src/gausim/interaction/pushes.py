"""Forces as accelerations of kernels, the terms of an interaction's sum."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.core import GaussianScene
from gausim.ops.covariance import kernel_volumes

# Largest factor by which a kernel's exposure to wind differs from the mean.
_EXPOSURE = 4.0


@dataclass(eq=False)
class Push:
    """An active force: a mask of kernels, their acceleration [scene units / s^2], and the steps left (None: no end)."""

    mask: Bool[Tensor, " K"]
    acceleration: tuple[float, float, float]
    left: int | None


def exposure(scene: GaussianScene, masses: Tensor, free: Tensor) -> Float[Tensor, " K"]:
    """Acceleration of kernels by wind relative to the object's mean: cross-section over mass, V^(2/3) / m."""
    volume = kernel_volumes(scene.log_scales, scene.volume_scale).to(masses)
    over_mass = torch.where(free, volume.pow(2 / 3) / masses.clamp_min(torch.finfo(masses.dtype).tiny), 0.0)
    mean = (over_mass * masses).sum() / (masses * free).sum()
    bounded = torch.where(free, (over_mass / mean).clamp(1 / _EXPOSURE, _EXPOSURE), 0.0)
    return bounded * ((masses * free).sum() / (bounded * masses).sum())


def scaled(direction: tuple[float, float, float], length: float) -> tuple[float, float, float]:
    """The vector of the given direction and length."""
    x, y, z = direction
    factor = length / math.hypot(x, y, z)
    return x * factor, y * factor, z * factor
