"""Conversion of frames to viser's buffers: placement, scale and packing into 32 bytes per kernel."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt32
from torch import Tensor

from gausim.core import GaussianScene

# Diagonal of the simulated kernels on the page. Covariances are float16, whose smallest step is 6e-8: at this size the
# variance of a kernel of a thousandth of the diagonal is accurate to 1 %.
SIZE = 4.0
# Half a unit in the last place of float16, relative and for subnormal numbers.
_ROUNDING, _SMALLEST = 2.0**-11, 2.0**-25
# The largest variance that is drawn; 65504 is the largest float16.
_LARGEST = 6e4


@dataclass(frozen=True, eq=False)
class Placing:
    """Map from the scene to the page: (x - centre) * scale."""

    centre: Float[Tensor, " 3"]  # centre of the simulated kernels' bounding box at rest [scene units]
    scale: float  # page units per scene unit

    @staticmethod
    def of(scene: GaussianScene) -> "Placing":
        """Centres the simulated kernels and scales their diagonal to :data:`SIZE`."""
        moving = scene.means[scene.simulated].float().cpu()
        return Placing((moving.amax(0) + moving.amin(0)) / 2, SIZE / scene.diagonal)

    def to_page(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Maps points from the scene to the page."""
        return (points.cpu() - self.centre.to(points.dtype)) * self.scale

    def to_scene(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Maps points from the page to the scene."""
        return points / self.scale + self.centre.to(points.dtype)


def pack(
    positions: Float[Tensor, "K 3"],
    covars: Float[Tensor, "K 3 3"],
    rgb: Float[Tensor, "K 3"],
    opacities: Float[Tensor, " K"],
    placing: Placing,
) -> UInt32[np.ndarray, "K 8"]:
    """Kernels in viser's layout: centre (3 float32), 4 bytes unused, covariance (6 float16), RGBA (4 uint8).

    Rounding to float16 may make a covariance indefinite. To prevent this, its diagonal is increased by twice the bound
    3 * 2^-11 max(S) of the rounding error's spectral norm, 0.3 % of the largest variance.
    """
    buffer = np.zeros((len(positions), 8), np.uint32)
    buffer[:, :3] = placing.to_page(positions).contiguous().float().numpy().view(np.uint32)
    buffer[:, 4:7] = half_covariances(covars.float().cpu() * placing.scale**2).view(np.uint32)
    rgba = torch.cat((rgb, opacities[:, None].to(rgb)), -1)
    buffer[:, 7:] = (rgba.clamp(0, 1) * 255 + 0.5).to(torch.uint8).contiguous().numpy().view(np.uint32)
    return buffer


def add_splats(scene: Any, name: str, buffer: UInt32[np.ndarray, "K 8"]) -> Any:
    """Adds packed kernels to a viser scene; setting ``buffer`` of the returned node replaces them."""
    count = len(buffer)
    node = scene.add_gaussian_splats(
        name, centers=np.zeros((count, 3)), covariances=np.tile(np.eye(3), (count, 1, 1)), rgbs=np.zeros((count, 3)),
        opacities=np.zeros((count, 1)),
    )  # fmt: skip
    node.buffer = buffer
    return node


def half_covariances(covars: Float[Tensor, "K 3 3"]) -> np.ndarray:
    """(K, 6) xx xy xz yy yz zz in float16, positive definite where the covariances are positive semi-definite."""
    largest = covars.diagonal(dim1=-2, dim2=-1).amax(-1)
    covars = covars * (_LARGEST / largest.clamp_min(_LARGEST))[:, None, None]
    margin = 2 * 3 * (_ROUNDING * largest.clamp_max(_LARGEST) + _SMALLEST)
    upper = covars.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]].clone()
    upper[:, [0, 3, 5]] += margin[:, None]
    return upper.numpy().astype(np.float16)


def unit_centres(
    positions: Float[Tensor, "K 3"], units: Int[Tensor, " K"], masses: Float[Tensor, " K"], count: int
) -> Float[Tensor, "N 3"]:
    """Centres of mass of the units of a level; -1 marks kernels of no unit."""
    inside = units >= 0
    index, mass = units[inside], masses[inside].to(positions)
    total = positions.new_zeros(count).index_add(0, index, mass)
    summed = positions.new_zeros(count, 3).index_add(0, index, positions[inside] * mass[:, None])
    return summed / total.clamp_min(torch.finfo(positions.dtype).tiny)[:, None]
