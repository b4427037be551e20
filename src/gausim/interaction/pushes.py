"""Forces as accelerations of kernels: what an interaction adds up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.core import GaussianScene
from gausim.ops.covariance import kernel_volumes

# The exposure of a kernel to wind over the mean one stays within this factor.
_EXPOSURE = 4.0


@dataclass(eq=False)
class Push:
    """A force that acts: acceleration vector of the kernels of a mask, and how many more steps."""

    mask: Bool[Tensor, " K"]
    acceleration: tuple[float, float, float]
    left: int | None


def exposure(scene: GaussianScene, masses: Tensor, free: Tensor) -> Float[Tensor, " K"]:
    """Acceleration of a kernel by wind over the mean one of the object: cross-section over mass, V^(2/3) / m."""
    volume = kernel_volumes(scene.log_scales, scene.volume_scale).to(masses)
    over_mass = torch.where(free, volume.pow(2 / 3) / masses.clamp_min(torch.finfo(masses.dtype).tiny), 0.0)
    mean = (over_mass * masses).sum() / (masses * free).sum()
    bounded = torch.where(free, (over_mass / mean).clamp(1 / _EXPOSURE, _EXPOSURE), 0.0)
    return bounded * ((masses * free).sum() / (bounded * masses).sum())


def scaled(direction: tuple[float, float, float], length: float) -> tuple[float, float, float]:
    """A vector in a direction, so long."""
    x, y, z = direction
    factor = length / math.hypot(x, y, z)
    return x * factor, y * factor, z * factor
