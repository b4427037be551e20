"""Particles for the interior of hollow objects."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gausim.baselines.mpm import Filling, fill_interior

DEVIATION, CELL = 0.035, 0.05


def sphere(radius: float, count: int = 3000) -> Tensor:
    """Points on a sphere about (1, 1, 1), evenly (Fibonacci)."""
    n = torch.arange(count) + 0.5
    z, angle = 1 - 2 * n / count, math.pi * (3 - 5**0.5) * n
    flat = (1 - z * z).sqrt()
    return 1 + radius * torch.stack((flat * angle.cos(), flat * angle.sin(), z), -1)


def distances(points: Tensor) -> Tensor:
    """Distances from (1, 1, 1) of the particles that fill round kernels at the points."""
    covars = (DEVIATION**2 * torch.eye(3)).expand(len(points), 3, 3)
    filling = Filling(cells=round(2 / CELL), per_cell=4)
    return (fill_interior(points, covars, torch.ones(len(points)), 2.0, filling) - 1).norm(dim=-1)


def test_a_hollow_sphere_is_filled_inside_and_only_there() -> None:
    found = distances(sphere(0.5))
    assert float(found.max()) < 0.5 + 3 * DEVIATION + CELL  # the shell and what is in it
    core = 4 / 3 * math.pi * 0.4**3
    assert float((found < 0.4).sum()) / 4 * CELL**3 == pytest.approx(core, rel=0.05)
    between = distances(torch.cat((sphere(0.6, 6000), sphere(0.3))))
    assert ((between > 0.4) & (between < 0.5)).any() and not (between < 0.15).any()  # the ray meets two walls there
