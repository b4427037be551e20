"""Particles for the interior of an object, whose kernels lie on its surface (PhysGaussian, Xie et al., CVPR 2024)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.baselines.mpm.config import Grid
from gausim.core import ConfigError

REACH = 3.0  # standard deviations up to which a kernel adds to the density


@dataclass(frozen=True)
class Filling:
    """Thresholds of interior filling.

    Attributes:
        cells: cells per axis of the density grid, which covers the whole domain.
        dense: density above which a cell is matter and gets particles.
        wall: density above which a cell stops a ray.
        per_cell: particles in a filled cell.
        ray_axis: axis along which walls are counted; an odd number means inside.
        open_side: side on which no wall is required, as [axis, +1 or -1], for example [2, -1] for an object that was
            not seen from below; None requires walls on all sides.
        seed: seed of the particles' positions within their cells.
    """

    cells: int = 50
    dense: float = 5.0
    wall: float = 3.0
    per_cell: int = 8
    ray_axis: int = 0
    open_side: tuple[int, int] | list[int] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.ray_axis not in (0, 1, 2):
            raise ConfigError(f"filling.ray_axis: expected 0, 1 or 2, got {self.ray_axis}.")
        if self.open_side is not None and tuple(self.open_side) == (self.ray_axis, 1):
            raise ConfigError(
                f"filling.open_side: {self.open_side} has no wall, so walls cannot be counted on that side. "
                "Change filling.ray_axis."
            )


def fill_interior(
    means: Float[Tensor, "K 3"],
    covars: Float[Tensor, "K 3 3"],
    opacities: Float[Tensor, " K"],
    size: float,
    options: Filling,
) -> Float[Tensor, "M 3"]:
    """Positions of particles that fill dense and enclosed cells of a domain of edge ``size`` [simulation units].

    The density of a cell is the sum of opacity exp(-d^T S^-1 d / 2) at its centre. Cells denser than ``dense`` get
    particles until they have ``per_cell``, as do enclosed cells that contain no kernel.
    """
    grid = Grid(options.cells, size)
    x, s, o = (v.detach().cpu().double().numpy() for v in (means, covars, opacities))
    density = splat_density(x, s, o, grid)
    count = np.histogramdd(x, bins=grid.cells, range=[(0, size)] * 3)[0].astype(np.int64)
    filled = (density > options.dense) | ((count == 0) & enclosed(density > options.wall, options))
    missing = np.where(filled, np.maximum(options.per_cell - count, 0), 0)
    cells = np.repeat(np.argwhere(missing > 0), missing[missing > 0], axis=0)
    places = (cells + np.random.default_rng(options.seed).random(cells.shape)) * grid.dx
    return torch.from_numpy(places).to(means)


def splat_density(
    means: Float[np.ndarray, "K 3"], covars: Float[np.ndarray, "K 3 3"], opacities: Float[np.ndarray, " K"], grid: Grid
) -> Float[np.ndarray, "n n n"]:
    """Sum of opacity exp(-d^T S^-1 d / 2) at the cell centres, each kernel up to 3 of its largest deviations."""
    eigenvalues, axes = np.linalg.eigh(covars)
    # The original takes the radius from the eigenvalues of S^-1: flat kernels then cover the whole grid.
    eigenvalues = np.maximum(eigenvalues, 1e-12 * grid.size**2)
    radius = REACH * np.sqrt(eigenvalues[:, -1:])
    precision = np.einsum("kij,kj,klj->kil", axes, 1 / eigenvalues, axes)
    low = np.clip(np.floor((means - radius) / grid.dx), 0, grid.cells).astype(int)
    high = np.clip(np.floor((means + radius) / grid.dx) + 1, 0, grid.cells).astype(int)
    density = np.zeros((grid.cells,) * 3)
    centres = (np.moveaxis(np.indices(density.shape), 0, -1) + 0.5) * grid.dx
    for k in range(len(means)):
        window = tuple(slice(a, b) for a, b in zip(low[k], high[k], strict=True))
        d = centres[window] - means[k]
        density[window] += opacities[k] * np.exp(-0.5 * ((d @ precision[k]) * d).sum(-1))
    return density


def enclosed(wall: Bool[np.ndarray, "n n n"], options: Filling) -> Bool[np.ndarray, "n n n"]:
    """Cells with walls in all six directions along the axes and an odd number of them above along ``ray_axis``."""
    inside = np.ones_like(wall)
    for axis in range(3):
        for side in (1, -1):
            if options.open_side is None or tuple(options.open_side) != (axis, side):
                along = np.flip(wall, axis) if side > 0 else wall
                beyond_a_wall = np.logical_or.accumulate(along, axis)
                inside &= np.flip(beyond_a_wall, axis) if side > 0 else beyond_a_wall
    begins = np.diff(wall.astype(np.int8), axis=options.ray_axis, prepend=0) == 1  # the first cell of every wall
    above = begins.sum(options.ray_axis, keepdims=True) - begins.cumsum(options.ray_axis)
    return inside & (above % 2 == 1)
