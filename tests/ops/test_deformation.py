from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from gausim.ops.deformation import bounded_deformation, deformation_gradient_from_output, determinant, polar_rotation


def _outputs(scale: float, dtype: torch.dtype = torch.float64) -> Tensor:
    return scale * torch.randn(200, 11, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize(
    ("scale", "dtype"), [(0.5, torch.float32), (1.0, torch.float64), (20.0, torch.float64), (1e4, torch.float64)]
)
def test_mass_on_gives_determinant_one_for_large_outputs(scale: float, dtype: torch.dtype) -> None:
    gradient, _ = deformation_gradient_from_output(_outputs(scale, dtype), conserve_mass=True)
    assert (torch.linalg.det(gradient.double()) - 1).abs().max() < 1e-5
    assert (gradient - torch.eye(3, dtype=dtype)).abs().amax((-1, -2)).min() > 1e-2  # no trivial identity


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_it_is_u_times_clamped_stretches_times_v_transposed(scale: float) -> None:
    output = _outputs(scale)
    gradient, rotation = deformation_gradient_from_output(output, conserve_mass=False)
    first = np.array([1.0, 0, 0, 0])
    u, v = (Rotation.from_quat(q.numpy() + first, scalar_first=True).as_matrix() for q in output[:, :8].split(4, 1))
    stretches = output[:, 8:].clamp(-5, 5).exp().numpy()
    np.testing.assert_allclose(gradient, np.einsum("nij,nj,nkj->nik", u, stretches, v), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(rotation, u @ v.transpose(0, 2, 1), atol=1e-12)
    assert (torch.linalg.det(gradient) - 1).abs().median() > 0.5


def test_zero_output_is_the_identity() -> None:
    for conserve in (True, False):
        for value in deformation_gradient_from_output(torch.zeros(4, 11), conserve_mass=conserve):
            assert torch.equal(value, torch.eye(3).expand(4, 3, 3))


def test_gradcheck_of_the_head() -> None:
    output = _outputs(0.7)[:4].requires_grad_()
    assert torch.autograd.gradcheck(lambda x: deformation_gradient_from_output(x, conserve_mass=True), output)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bounded_deformation_keeps_valid_matrices_up_to_volume_and_replaces_the_others(dtype) -> None:
    a = torch.eye(3) + 0.4 * torch.randn(80, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    a, kept = a.to(dtype), torch.linalg.det(a) >= 0.2
    assert torch.allclose(determinant(a), torch.linalg.det(a), atol=1e-5)
    assert 20 < int(kept.sum()) < 75
    free, unit = (bounded_deformation(a, 0.2, unit=u) for u in (False, True))
    assert torch.equal(free[kept], a[kept])
    for bounded in (free, unit):
        assert torch.equal(bounded[~kept], torch.eye(3, dtype=dtype).expand(int((~kept).sum()), 3, 3))
    assert torch.allclose(torch.linalg.det(unit), torch.ones(80, dtype=dtype), atol=1e-5)
    assert torch.allclose(unit[kept] * a[kept][:, :1, :1], a[kept] * unit[kept][:, :1, :1], atol=1e-5)
    broken = torch.full((2, 3, 3), float("nan"), dtype=dtype)
    assert bool(bounded_deformation(broken, 0.2, unit=True).isnan().all())


def test_polar_rotation_equals_the_singular_value_decomposition() -> None:
    # stretches up to a factor of 8 in every direction, any rotation
    generator = torch.Generator().manual_seed(2)
    u, v = (torch.linalg.qr(torch.randn(60, 3, 3, generator=generator, dtype=torch.float64))[0] for _ in range(2))
    u, v = (q * torch.linalg.det(q)[:, None, None] for q in (u, v))
    stretch = torch.exp(2 * torch.rand(60, 3, generator=generator, dtype=torch.float64) * 2 - 2)
    gradient = (u * stretch[:, None, :]) @ v.mT
    assert torch.allclose(polar_rotation(gradient), u @ v.mT, atol=1e-6)
