from __future__ import annotations

import math

import torch

from gausim.ops.covariance import covariance_from_scales, kernel_volumes, transport_covariance
from gausim.ops.rotation import quaternion_to_matrix

G = torch.Generator().manual_seed(0)
LOG_SCALES = torch.randn(12, 3, generator=G, dtype=torch.float64) * 0.5 - 2
QUATS = torch.randn(12, 4, generator=G, dtype=torch.float64)


def test_principal_axes_are_the_rotated_axes_with_squared_scales() -> None:
    covars, axes = covariance_from_scales(LOG_SCALES, QUATS), quaternion_to_matrix(QUATS)
    for i in range(3):
        axis = axes[:, :, i]
        assert torch.allclose((covars @ axis[..., None])[..., 0], axis * (2 * LOG_SCALES[:, i : i + 1]).exp())


def test_transport_is_the_covariance_of_deformed_samples() -> None:
    gradient = torch.eye(3, dtype=torch.float64) + 0.4 * torch.randn(12, 3, 3, generator=G, dtype=torch.float64)
    root = torch.linalg.cholesky(covariance_from_scales(LOG_SCALES, QUATS))
    moved = gradient @ root
    assert torch.allclose(transport_covariance(root @ root.mT, gradient), moved @ moved.mT)


def test_volume_is_proportional_to_the_root_of_det_two_pi_sigma() -> None:
    volume = kernel_volumes(LOG_SCALES, 300.0)
    root = torch.linalg.det(2 * math.pi * covariance_from_scales(LOG_SCALES, QUATS)).sqrt()
    assert torch.allclose(volume, root * (300.0**3 / (2 * math.pi) ** 1.5), rtol=1e-9)
