from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gausim.ops.spherical_harmonics import C0, evaluate_sh, spherical_harmonics_basis


def test_basis_is_orthonormal_on_the_sphere() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(8)  # exact for the products of two functions of degree 3
    phi = np.arange(16) * 2 * math.pi / 16
    z, angle = (torch.from_numpy(v.ravel()) for v in np.meshgrid(nodes, phi, indexing="ij"))
    r = (1 - z * z).sqrt()
    basis = spherical_harmonics_basis(3, torch.stack((r * angle.cos(), r * angle.sin(), z), -1))
    weight = torch.from_numpy(np.repeat(weights, 16) * 2 * math.pi / 16)
    gram = torch.einsum("nb,nc,n->bc", basis, basis, weight)
    assert torch.allclose(gram, torch.eye(16, dtype=torch.float64), atol=1e-12)


def test_first_degree_follows_the_sign_convention_of_3dgs_files() -> None:
    basis = spherical_harmonics_basis(1, torch.eye(3))
    c1 = math.sqrt(3 / (4 * math.pi))
    assert torch.allclose(basis[:, 0], torch.full((3,), C0))
    assert torch.allclose(basis[:, 1:], c1 * torch.tensor([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]]))


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_colour_is_half_plus_the_sum_and_never_negative(coefficients: int) -> None:
    generator = torch.Generator().manual_seed(coefficients)
    sh = torch.randn(50, coefficients, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator), dim=-1)
    colour = evaluate_sh(sh, directions)
    basis = spherical_harmonics_basis(math.isqrt(coefficients) - 1, directions)
    raw = sum(basis[:, b, None] * sh[:, b] for b in range(coefficients)) + 0.5
    assert torch.allclose(colour, raw.clamp_min(0), atol=1e-6)
    assert bool((raw < 0).any()) and float(colour.min()) == 0
