"""Coordinates, volumes and the filling of hollow objects."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gausim.baselines.mpm import Filling, Grid, SceneMapping, fill_interior, particle_volumes
from gausim.core import ConfigError

DOMAIN = Grid(cells=20, size=2.0)


def cloud() -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(200, 3, generator=generator) * torch.tensor([3.0, 0.5, 1.2]) + torch.tensor([-7.0, 2.0, 0.1])


def test_mapping_there_and_back():
    points, mapping = cloud(), SceneMapping(0.4, (1.0, 2.0, -0.5))
    inside = mapping.to_simulation(points)
    assert torch.allclose(inside[:, 1], 0.4 * points[:, 1] + 2.0)
    assert torch.allclose(mapping.to_scene(inside), points, atol=1e-5)


def test_volumes_share_the_cell():
    grid = Grid(cells=10, size=1.0)
    x = torch.tensor([[0.51, 0.51, 0.51], [0.58, 0.52, 0.55], [0.65, 0.52, 0.55]])
    assert torch.allclose(particle_volumes(x, grid), torch.tensor([0.5, 0.5, 1.0]) * 1e-3)


def sphere(radius: float, count: int = 3000) -> Tensor:
    """Points on a sphere round (1, 1, 1), evenly (Fibonacci)."""
    n = torch.arange(count) + 0.5
    z, angle = 1 - 2 * n / count, math.pi * (3 - 5**0.5) * n
    flat = (1 - z * z).sqrt()
    return 1 + radius * torch.stack((flat * angle.cos(), flat * angle.sin(), z), -1)


def filled(points: Tensor, options: Filling, deviation: float = 0.035) -> Tensor:
    covars = (deviation**2 * torch.eye(3)).expand(len(points), 3, 3)
    return fill_interior(points, covars, torch.ones(len(points)), DOMAIN, options)


def test_a_hollow_sphere_is_filled_and_nothing_else():
    found = filled(sphere(0.5), Filling(cells=40, per_cell=4))
    distance = (found - 1).norm(dim=-1)
    assert distance.max() < 0.5 + 3 * 0.035 + 0.05  # the shell and what is in it
    in_core = (distance < 0.4).sum() / 4 * 0.05**3
    print(f"filled volume of the core {float(in_core):.4f}, true {4 / 3 * math.pi * 0.4**3:.4f}")
    assert float(in_core) == pytest.approx(4 / 3 * math.pi * 0.4**3, rel=0.05)
    cell = (found / 0.05).floor().long()
    assert torch.unique(cell, dim=0, return_counts=True)[1].amax() <= 4
    assert torch.equal(found, filled(sphere(0.5), Filling(cells=40, per_cell=4)))


def test_what_lies_beside_or_between_shells_stays_empty():
    shells = torch.cat((sphere(0.6, 6000), sphere(0.3, 3000)))
    distance = (filled(shells, Filling(cells=40)) - 1).norm(dim=-1)
    assert ((distance > 0.4) & (distance < 0.5)).any() and not (distance < 0.15).any()  # inside, outside by parity
    pair = torch.cat((sphere(0.3, 2000) - torch.tensor([0.45, 0, 0]), sphere(0.3, 2000) + torch.tensor([0.45, 0, 0])))
    between = filled(pair, Filling(cells=40))[:, 0]
    assert not ((between - 1).abs() < 0.02).any()


def test_an_open_bowl_is_filled_only_if_its_side_is_named():
    bowl = sphere(0.5)
    bowl = bowl[bowl[:, 2] > 0.8]  # nothing below

    def core(options: Filling) -> int:
        return int(((filled(bowl, options) - torch.tensor([1.0, 1.0, 1.0])).norm(dim=-1) < 0.3).sum())

    assert core(Filling(cells=40)) < 0.3 * core(Filling(cells=40, open_side=(2, -1)))
    with pytest.raises(ConfigError, match="open_side"):
        Filling(open_side=(0, 1))


def test_thin_gaussians_are_splatted_near_themselves():
    """The original took the radius from the inverse covariance: needles then covered the whole grid."""
    points = sphere(0.5)
    needles = torch.diag(torch.tensor([1e-5, 0.03, 0.03]) ** 2).expand(len(points), 3, 3)
    found = fill_interior(points, needles, torch.ones(len(points)), DOMAIN, Filling(cells=40))
    assert not len(found) or float((found - 1).norm(dim=-1).max()) < 0.7
