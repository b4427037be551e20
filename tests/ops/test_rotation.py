from __future__ import annotations

import math

import torch

from gausim.ops.rotation import quaternion_to_matrix, rotation_of, rotation_vector


def _product(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    cross = torch.linalg.cross(p[:, 1:], q[:, 1:])
    scalar = p[:, :1] * q[:, :1] - (p[:, 1:] * q[:, 1:]).sum(-1, keepdim=True)
    return torch.cat((scalar, p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + cross), -1)


def test_turn_of_ninety_degrees_about_z_takes_x_to_y() -> None:
    half = math.pi / 4
    r = quaternion_to_matrix(torch.tensor([[math.cos(half), 0, 0, math.sin(half)], [1, 0, 0, 0]]))
    assert torch.allclose(r[0] @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]), atol=1e-6)
    assert torch.equal(r[1], torch.eye(3))


def test_rotations_of_any_length_compose_as_quaternions_do() -> None:
    p, q = torch.randn(2, 40, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    a, b = quaternion_to_matrix(p), quaternion_to_matrix(q)
    eye = torch.eye(3, dtype=torch.float64).expand_as(a)
    assert torch.allclose(a @ a.mT, eye, atol=1e-12)
    assert torch.allclose(torch.linalg.det(a), torch.ones(40, dtype=torch.float64))
    assert torch.allclose(quaternion_to_matrix(_product(p, q)), a @ b, atol=1e-12)
    assert torch.allclose(quaternion_to_matrix(-7.5 * p), a, atol=1e-12)


def test_the_vector_of_a_rotation() -> None:
    vector = torch.tensor([0.4, -0.9, 0.3], dtype=torch.float64)
    torch.testing.assert_close(rotation_vector(rotation_of(vector)), vector)
    torch.testing.assert_close(rotation_vector(torch.eye(3).double()), torch.zeros(3).double())
