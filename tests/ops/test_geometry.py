"""Rotations, covariances, deformation gradients, spherical harmonics, orbit cameras and the visual hull."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from gausim.core import GaussianScene
from gausim.ops.covariance import covariance_from_scales, kernel_volumes, transport_covariance
from gausim.ops.deformation import bounded_deformation, deformation_gradient_from_output, determinant, polar_rotation
from gausim.ops.deformed_scene import deformed_scene, matrix_to_quaternion, rotate_sh
from gausim.ops.orbit import orbit_cameras
from gausim.ops.rotation import quaternion_to_matrix, rotation_of, rotation_vector
from gausim.ops.spherical_harmonics import C0, evaluate_sh, spherical_harmonics_basis
from gausim.ops.visual_hull import VoxelHull, carve, project, search_cube


def _product(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    cross = torch.linalg.cross(p[:, 1:], q[:, 1:])
    scalar = p[:, :1] * q[:, :1] - (p[:, 1:] * q[:, 1:]).sum(-1, keepdim=True)
    return torch.cat((scalar, p[:, :1] * q[:, 1:] + q[:, :1] * p[:, 1:] + cross), -1)


def test_rotations_compose_as_quaternions_do_and_have_a_vector() -> None:
    half = math.pi / 4
    r = quaternion_to_matrix(torch.tensor([[math.cos(half), 0, 0, math.sin(half)], [1, 0, 0, 0]]))
    assert torch.allclose(r[0] @ torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]), atol=1e-6)
    assert torch.equal(r[1], torch.eye(3))
    p, q = torch.randn(2, 40, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    a, b = quaternion_to_matrix(p), quaternion_to_matrix(q)
    eye = torch.eye(3, dtype=torch.float64).expand_as(a)
    assert torch.allclose(a @ a.mT, eye, atol=1e-12)
    assert torch.allclose(torch.linalg.det(a), torch.ones(40, dtype=torch.float64))
    assert torch.allclose(quaternion_to_matrix(_product(p, q)), a @ b, atol=1e-12)
    assert torch.allclose(quaternion_to_matrix(-7.5 * p), a, atol=1e-12)
    vector = torch.tensor([0.4, -0.9, 0.3], dtype=torch.float64)
    torch.testing.assert_close(rotation_vector(rotation_of(vector)), vector)
    torch.testing.assert_close(rotation_vector(torch.eye(3).double()), torch.zeros(3).double())


G = torch.Generator().manual_seed(0)
LOG_SCALES = torch.randn(12, 3, generator=G, dtype=torch.float64) * 0.5 - 2
QUATS = torch.randn(12, 4, generator=G, dtype=torch.float64)


def test_covariances_turn_deform_and_have_a_volume() -> None:
    covars, axes = covariance_from_scales(LOG_SCALES, QUATS), quaternion_to_matrix(QUATS)
    for i in range(3):
        axis = axes[:, :, i]
        assert torch.allclose((covars @ axis[..., None])[..., 0], axis * (2 * LOG_SCALES[:, i : i + 1]).exp())
    gradient = torch.eye(3, dtype=torch.float64) + 0.4 * torch.randn(12, 3, 3, generator=G, dtype=torch.float64)
    root = torch.linalg.cholesky(covariance_from_scales(LOG_SCALES, QUATS))
    moved = gradient @ root
    assert torch.allclose(transport_covariance(root @ root.mT, gradient), moved @ moved.mT)
    volume = kernel_volumes(LOG_SCALES, 300.0)
    root = torch.linalg.det(2 * math.pi * covariance_from_scales(LOG_SCALES, QUATS)).sqrt()
    assert torch.allclose(volume, root * (300.0**3 / (2 * math.pi) ** 1.5), rtol=1e-9)


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


def test_the_head_is_the_identity_at_zero_and_differentiable() -> None:
    for conserve in (True, False):
        for value in deformation_gradient_from_output(torch.zeros(4, 11), conserve_mass=conserve):
            assert torch.equal(value, torch.eye(3).expand(4, 3, 3))
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


def test_polar_rotations_and_quaternions_of_matrices() -> None:
    generator = torch.Generator().manual_seed(2)
    u, v = (torch.linalg.qr(torch.randn(60, 3, 3, generator=generator, dtype=torch.float64))[0] for _ in range(2))
    u, v = (q * torch.linalg.det(q)[:, None, None] for q in (u, v))
    stretch = torch.exp(2 * torch.rand(60, 3, generator=generator, dtype=torch.float64) * 2 - 2)
    gradient = (u * stretch[:, None, :]) @ v.mT
    assert torch.allclose(polar_rotation(gradient), u @ v.mT, atol=1e-6)
    quats = torch.cat((normal(50, 4), torch.eye(4, dtype=torch.float64)))
    matrix = quaternion_to_matrix(quats)
    back = matrix_to_quaternion(matrix)
    assert torch.allclose(quaternion_to_matrix(back), matrix, atol=1e-12)
    assert (back[:, 0] >= 0).all() and torch.allclose(back.norm(dim=-1), torch.ones(54, dtype=torch.float64))


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


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
    expected = transport_covariance(covariance_from_scales(scene.log_scales, scene.quats), deformation_gradients[unit])
    assert torch.allclose(covariance_from_scales(moved.log_scales, moved.quats), expected, rtol=1e-4, atol=1e-5)
    still = unit == 0
    for name in ("log_scales", "quats", "sh"):
        assert torch.equal(getattr(moved, name)[still], getattr(scene, name)[still])
        assert not torch.equal(getattr(moved, name)[~still], getattr(scene, name)[~still])
    assert torch.equal(moved.means, scene.means + 1)


def test_the_basis_is_orthonormal_with_the_signs_of_3dgs_files() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(8)  # exact for the products of two functions of degree 3
    phi = np.arange(16) * 2 * math.pi / 16
    z, angle = (torch.from_numpy(v.ravel()) for v in np.meshgrid(nodes, phi, indexing="ij"))
    r = (1 - z * z).sqrt()
    basis = spherical_harmonics_basis(3, torch.stack((r * angle.cos(), r * angle.sin(), z), -1))
    weight = torch.from_numpy(np.repeat(weights, 16) * 2 * math.pi / 16)
    gram = torch.einsum("nb,nc,n->bc", basis, basis, weight)
    assert torch.allclose(gram, torch.eye(16, dtype=torch.float64), atol=1e-12)
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


@pytest.mark.parametrize("up", ["z", "y", "-y", "x"])
def test_cameras_see_the_scene_upright_and_in_the_middle(up: str):
    means = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) + 5.0
    cameras = orbit_cameras(means, azimuths=(0.0, 90.0, 200.0), up=up, size=(64, 48)).validated("orbit")
    assert cameras.names == ("azimuth_0", "azimuth_90", "azimuth_200")
    vertical = torch.zeros(3)
    vertical["xyz".index(up[-1])] = -0.2 if up.startswith("-") else 0.2
    middle = means.median(0).values
    for viewmat, k in zip(cameras.viewmats, cameras.Ks, strict=True):
        points = torch.cat((means, middle[None], (middle + vertical)[None])) @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = points @ k.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        assert (points[:, 2] > 0).all()
        inside = (pixels >= 0) & (pixels <= torch.tensor([64.0, 48.0]))
        assert inside.all(-1).float().mean() > 0.97
        assert torch.allclose(pixels[-2], torch.tensor([32.0, 24.0]), atol=1e-2)
        assert pixels[-1, 1] < pixels[-2, 1] - 1  # up in the world is up in the picture
    between = torch.cdist(cameras.centers, cameras.centers)
    assert (between + 10 * torch.eye(3)).min() > 1


RADIUS = 0.4
CENTER = torch.tensor([0.1, -0.2, 0.3])


def cameras_around(count: int, distance: float = 3.0, size: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    """Cameras that look at a point near the sphere from all directions (a spiral)."""
    viewmats, Ks = [], torch.tensor([[80.0, 0, size / 2], [0, 80.0, size / 2], [0, 0, 1]]).expand(count, 3, 3)
    for i in range(count):
        z = 1 - 2 * (i + 0.5) / count
        angle = torch.tensor(2.39996 * i)
        away = torch.stack((angle.cos() * (1 - z * z) ** 0.5, angle.sin() * (1 - z * z) ** 0.5, torch.tensor(z)))
        forward = -away
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.3, 1.0])), dim=0)
        rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
        viewmat = torch.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (distance * away)
        viewmats.append(viewmat)
    return torch.stack(viewmats), Ks


def sphere_masks(viewmats: torch.Tensor, Ks: torch.Tensor, size: int = 64) -> torch.Tensor:
    axis = torch.arange(size) + 0.5
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    masks = []
    for viewmat, K in zip(viewmats, Ks, strict=True):
        ray = torch.stack(((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)), -1)
        ray = torch.nn.functional.normalize(ray, dim=-1)
        center = viewmat[:3, :3] @ CENTER + viewmat[:3, 3]
        off = (center - (ray @ center)[..., None] * ray).norm(dim=-1)
        masks.append(off < RADIUS)
    return torch.stack(masks)


@pytest.fixture(scope="module")
def hull() -> VoxelHull:
    viewmats, Ks = cameras_around(24)
    found = carve(sphere_masks(viewmats, Ks), viewmats, Ks, 32)
    assert found is not None
    return found


def test_hull_and_surface_of_a_sphere(hull: VoxelHull) -> None:
    volume = float(hull.occupied.sum()) * hull.spacing**3
    assert 0.9 < volume / (4 / 3 * torch.pi * RADIUS**3) < 1.25
    middle = hull.origin + hull.occupied.nonzero().float().mean(0) * hull.spacing
    assert torch.allclose(middle, CENTER, atol=0.02)
    points, normals = hull.surface()
    radial = points - CENTER
    assert ((radial.norm(dim=-1) - RADIUS).abs() < 2.5 * hull.spacing).all()
    cosine = (torch.nn.functional.normalize(radial, dim=-1) * normals).sum(-1)
    assert float(cosine.min()) > 0.6 and float(cosine.mean()) > 0.93
    beyond = CENTER + torch.tensor([[0.0, 0, 0], [RADIUS + 3 * hull.spacing, 0, 0], [9.0, 9, 9], [-9.0, 0, 0]])
    assert hull.contains(beyond).tolist() == [True, False, False, False]
    grown = hull.dilated(3)
    assert grown.contains(beyond).tolist() == [True, True, False, False]
    inside = hull.origin + hull.occupied.nonzero() * hull.spacing
    assert grown.contains(inside).all() and grown.occupied.sum() > hull.occupied.sum()


def test_projection_search_cube_and_masks_that_disagree() -> None:
    viewmats, Ks = cameras_around(12)
    middle, half = search_cube(viewmats, Ks, (64, 64))
    assert torch.allclose(middle, torch.zeros(3), atol=1e-4)
    assert half == pytest.approx(3.0 * 32 / 80, rel=1e-4)
    pixels, depth = project(torch.zeros(2, 3), viewmats, Ks)
    assert torch.allclose(pixels, torch.full((12, 2, 2), 32.0), atol=1e-3)
    assert torch.allclose(depth, torch.full((12, 2), 3.0), atol=1e-4)
    viewmats, Ks = cameras_around(6)
    masks = sphere_masks(viewmats, Ks)
    masks[2] = False
    assert carve(masks, viewmats, Ks, 16) is None
