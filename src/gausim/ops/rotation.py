"""Rotations and the vectors that generate them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def cross_matrix(vector: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3 3"]:
    """[v]: the matrix with [v] w = v x w."""
    x, y, z = vector.unbind(-1)
    none = torch.zeros_like(x)
    return torch.stack((none, -z, y, z, none, -x, -y, x, none), -1).unflatten(-1, (3, 3))


def rotation_of(vector: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3 3"]:
    """The rotation by a vector of axis times angle [radian]."""
    return torch.linalg.matrix_exp(cross_matrix(vector))


def rotation_vector(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 3"]:
    """Axis times angle [radian] of a rotation by less than pi."""
    lower = rotation - rotation.mT
    axis = torch.stack((lower[2, 1], lower[0, 2], lower[1, 0])) / 2
    angle = torch.atan2(axis.norm(), (rotation.trace() - 1) / 2)
    return axis * (angle / angle.sin()) if angle > 1e-6 else axis
