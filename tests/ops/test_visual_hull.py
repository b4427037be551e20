"""The visual hull against a sphere whose silhouettes are known exactly."""

from __future__ import annotations

import pytest
import torch

from gausim.ops.visual_hull import VoxelHull, carve, project, search_cube

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


def test_hull_of_a_sphere_holds_it_and_little_more(hull: VoxelHull) -> None:
    volume = float(hull.occupied.sum()) * hull.spacing**3
    assert 0.9 < volume / (4 / 3 * torch.pi * RADIUS**3) < 1.25
    middle = hull.origin + hull.occupied.nonzero().float().mean(0) * hull.spacing
    assert torch.allclose(middle, CENTER, atol=0.02)


def test_surface_lies_on_the_sphere_with_outward_normals(hull: VoxelHull) -> None:
    points, normals = hull.surface()
    radial = points - CENTER
    assert ((radial.norm(dim=-1) - RADIUS).abs() < 2.5 * hull.spacing).all()
    cosine = (torch.nn.functional.normalize(radial, dim=-1) * normals).sum(-1)
    assert float(cosine.min()) > 0.6 and float(cosine.mean()) > 0.93


def test_contains_and_dilation(hull: VoxelHull) -> None:
    beyond = CENTER + torch.tensor([[0.0, 0, 0], [RADIUS + 3 * hull.spacing, 0, 0], [9.0, 9, 9], [-9.0, 0, 0]])
    assert hull.contains(beyond).tolist() == [True, False, False, False]
    grown = hull.dilated(3)
    assert grown.contains(beyond).tolist() == [True, True, False, False]
    inside = hull.origin + hull.occupied.nonzero() * hull.spacing
    assert grown.contains(inside).all() and grown.occupied.sum() > hull.occupied.sum()


def test_masks_that_disagree_leave_nothing() -> None:
    viewmats, Ks = cameras_around(6)
    masks = sphere_masks(viewmats, Ks)
    masks[2] = False
    assert carve(masks, viewmats, Ks, 16) is None


def test_projection_and_search_cube() -> None:
    viewmats, Ks = cameras_around(12)
    middle, half = search_cube(viewmats, Ks, (64, 64))
    assert torch.allclose(middle, torch.zeros(3), atol=1e-4)
    assert half == pytest.approx(3.0 * 32 / 80, rel=1e-4)
    pixels, depth = project(torch.zeros(2, 3), viewmats, Ks)
    assert torch.allclose(pixels, torch.full((12, 2, 2), 32.0), atol=1e-3)
    assert torch.allclose(depth, torch.full((12, 2), 3.0), atol=1e-4)
