from __future__ import annotations

import pytest
import torch

from gausim.core import GaussianScene
from gausim.ops.covariance import covariance_from_scales
from gausim.ops.deformed_scene import deformed_scene, matrix_to_quaternion, rotate_sh
from gausim.ops.rotation import quaternion_to_matrix
from gausim.ops.spherical_harmonics import spherical_harmonics_basis


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_quaternions_of_matrices_also_at_half_turns():
    quats = torch.cat((normal(50, 4), torch.eye(4, dtype=torch.float64)))
    matrix = quaternion_to_matrix(quats)
    back = matrix_to_quaternion(matrix)
    assert torch.allclose(quaternion_to_matrix(back), matrix, atol=1e-12)
    assert (back[:, 0] >= 0).all() and torch.allclose(back.norm(dim=-1), torch.ones(54, dtype=torch.float64))


@pytest.mark.parametrize(("degree", "count"), [(0, 1), (1, 4), (2, 9), (3, 16)])
def test_rotated_harmonics_shine_in_the_rotated_direction(degree: int, count: int):
    sh, rotation = normal(5, count, 3), quaternion_to_matrix(normal(5, 4, seed=1))
    directions = torch.nn.functional.normalize(normal(5, 7, 3, seed=2), dim=-1)
    rotated = spherical_harmonics_basis(degree, directions) @ rotate_sh(sh, rotation)
    original = spherical_harmonics_basis(degree, directions @ rotation) @ sh
    assert torch.allclose(rotated, original, atol=1e-10)


def test_deformed_covariances_and_untouched_kernels():
    scene = GaussianScene.create(
        means=normal(6, 3).float(), log_scales=0.3 * normal(6, 3, seed=1).float(), quats=normal(6, 4, seed=2).float(),
        opacity_logits=torch.zeros(6), sh=normal(6, 9, 3, seed=3).float(),
    )  # fmt: skip
    deformation_gradients = torch.stack((torch.eye(3), torch.eye(3) + 0.3 * normal(3, 3, seed=4).float()))
    rotations = torch.stack((torch.eye(3), quaternion_to_matrix(normal(1, 4, seed=5).float())[0]))
    unit = torch.tensor([0, 1, 1, 0, 1, 0])
    moved = deformed_scene(scene, scene.means + 1, deformation_gradients, rotations, unit)
    expected = (
        deformation_gradients[unit]
        @ covariance_from_scales(scene.log_scales, scene.quats)
        @ deformation_gradients[unit].mT
    )
    assert torch.allclose(covariance_from_scales(moved.log_scales, moved.quats), expected, rtol=1e-4, atol=1e-5)
    still = unit == 0
    for name in ("log_scales", "quats", "sh"):
        assert torch.equal(getattr(moved, name)[still], getattr(scene, name)[still])
        assert not torch.equal(getattr(moved, name)[~still], getattr(scene, name)[~still])
    assert torch.equal(moved.means, scene.means + 1)
