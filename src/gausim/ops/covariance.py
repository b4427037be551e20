"""Covariances of Gaussians and their transport by deformations."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.ops.rotation import quaternion_to_matrix


def covariance_from_scales(log_scales: Float[Tensor, "*N 3"], quats: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 3 3"]:
    """S = R diag(s^2) R^T [scene units^2], from 3DGS log-scales and w x y z quaternions."""
    factor = quaternion_to_matrix(quats) * torch.exp(log_scales)[..., None, :]
    return factor @ factor.mT


def transport_covariance(
    covars: Float[Tensor, "*#N 3 3"], deformation_gradient: Float[Tensor, "*#N 3 3"]
) -> Float[Tensor, "*#N 3 3"]:
    """G S G^T: the covariance of matter deformed by G (METHOD section 2)."""
    return deformation_gradient @ covars @ deformation_gradient.mT


def kernel_volumes(log_scales: Float[Tensor, "*N 3"], scale: float) -> Float[Tensor, " *N"]:
    """V = prod_i (c s_i) with the scene constant c = ``scale``: sqrt(det 2 pi S) up to a constant."""
    return torch.exp(log_scales.sum(-1) + 3 * math.log(scale))
