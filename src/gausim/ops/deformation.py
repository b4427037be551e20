"""Deformation gradients: their construction from network outputs, bounds and rotations."""

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.ops.rotation import quaternion_to_matrix

MAX_LOG_STRETCH = 5.0  # bound of the logarithmic stretch (METHOD section 2)
POLAR_ITERATIONS = 8


def deformation_gradient_from_output(
    output: Float[Tensor, "N 11"], *, conserve_mass: bool
) -> tuple[Float[Tensor, "N 3 3"], Float[Tensor, "N 3 3"]]:
    """F = U diag(lambda) V^T and its rotation U V^T from 11 numbers; zero output gives the identity.

    The first eight numbers are two quaternions relative to (1, 0, 0, 0), the last three logarithms of the stretches;
    with ``conserve_mass`` their mean is subtracted, so that det F = 1 (METHOD section 2).
    """
    one = torch.zeros(4, dtype=output.dtype, device=output.device)
    one[:1] = 1  # created on the device: a copy from the host would break the capture of a CUDA graph
    u, v = quaternion_to_matrix(output[:, :8].unflatten(1, (2, 4)) + one).unbind(1)
    stretch = torch.clamp(output[:, 8:11], -MAX_LOG_STRETCH, MAX_LOG_STRETCH)
    if conserve_mass:
        stretch = stretch - stretch.mean(-1, keepdim=True)
    return (u * torch.exp(stretch)[..., None, :]) @ v.mT, u @ v.mT


def bounded_deformation(
    deformation_gradient: Float[Tensor, "N 3 3"], least: float, *, unit: bool
) -> Float[Tensor, "N 3 3"]:
    """Deformation gradients with determinants of at least ``least`` > 0; others are replaced by the identity.

    ``unit`` scales them to determinant 1 (constant volume).
    """
    det = determinant(deformation_gradient)
    kept = ~(det < least)  # keeps NaN
    identity = torch.eye(3, dtype=deformation_gradient.dtype, device=deformation_gradient.device)
    bounded = torch.where(kept[:, None, None], deformation_gradient, identity)
    return bounded * torch.where(kept, det, 1.0).pow(-1 / 3)[:, None, None] if unit else bounded


def apply(matrix: Float[Tensor, "N 3 3"], vector: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """A v."""
    return (matrix @ vector[..., None])[..., 0]


def determinant(a: Float[Tensor, "*N 3 3"]) -> Float[Tensor, " *N"]:
    """Determinant of 3x3 matrices, written out: several times faster than LU on the CPU and exact to rounding."""
    return (a[..., 0, :] * torch.linalg.cross(a[..., 1, :], a[..., 2, :])).sum(-1)


def polar_rotation(deformation_gradient: Float[Tensor, "*N 3 3"]) -> Float[Tensor, "*N 3 3"]:
    """Rotation of the polar decomposition by Newton's iteration R <- (R + R^-T) / 2 (Higham 1986); det > 0 assumed."""
    rotation = deformation_gradient
    for _ in range(POLAR_ITERATIONS):
        cofactors = torch.linalg.cross(rotation.roll(-1, -2), rotation.roll(-2, -2))
        scale = (rotation[..., 0, :] * cofactors[..., 0, :]).sum(-1)  # the determinant
        rotation = 0.5 * (rotation + cofactors / scale[..., None, None])
    return rotation
