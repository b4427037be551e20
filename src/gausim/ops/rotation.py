"""Rotations, and the vectors and quaternions that describe them."""

import torch
from jaxtyping import Float
from torch import Tensor


def quaternion_to_matrix(quats: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 3 3"]:
    """Rotation matrices of quaternions w x y z of any non-zero length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1),
    )
    return torch.stack(rows, -2)


def cross_matrix(vector: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3 3"]:
    """[v]: the matrix with [v] w = v x w."""
    x, y, z = vector.unbind(-1)
    none = torch.zeros_like(x)
    return torch.stack((none, -z, y, z, none, -x, -y, x, none), -1).unflatten(-1, (3, 3))


def rotation_of(vector: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3 3"]:
    """The rotation by a vector of axis times angle [radian]."""
    return torch.linalg.matrix_exp(cross_matrix(vector))


def axial(matrix: Float[Tensor, "3 3"]) -> Float[Tensor, " 3"]:
    """sum_k r_k x s_k for the matrix sum_k s_k r_k^T."""
    lower = matrix - matrix.mT
    return torch.stack((lower[2, 1], lower[0, 2], lower[1, 0]))


def rotation_vector(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, " 3"]:
    """Axis times angle [radian] of a rotation by less than pi."""
    axis = axial(rotation) / 2
    angle = torch.atan2(axis.norm(), (rotation.trace() - 1) / 2)
    return axis * (angle / angle.sin()) if angle > 1e-6 else axis
