"""Particles for the interior of an object, whose kernels lie on its surface (PhysGaussian, Xie et al., CVPR 2024)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.baselines.mpm.config import Grid

REACH = 3.0  # standard deviations up to which a kernel adds to the density


@dataclass(frozen=True)
class Filling:
    """Thresholds of interior filling.

    Attributes:
        cells: cells per axis of the density grid, which covers the whole domain.
        dense: density above which a cell is matter and gets particles.
        wall: density above which a cell stops a ray.
        per_cell: particles in a filled cell.
    """

    cells: int = 50
    dense: float = 5.0
    wall: float = 3.0
    per_cell: int = 8


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
    filled = (density > options.dense) | ((count == 0) & enclosed(density > options.wall))
    missing = np.where(filled, np.maximum(options.per_cell - count, 0), 0)
    cells = np.repeat(np.argwhere(missing > 0), missing[missing > 0], axis=0)
    places = (cells + np.random.default_rng(0).random(cells.shape)) * grid.dx
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


def enclosed(wall: Bool[np.ndarray, "n n n"]) -> Bool[np.ndarray, "n n n"]:
    """Cells with walls in all six directions along the axes and an odd number of them ahead along the first axis."""
    inside = np.ones_like(wall)
    for axis in range(3):
        inside &= np.logical_or.accumulate(wall, axis)
        inside &= np.flip(np.logical_or.accumulate(np.flip(wall, axis), axis), axis)
    begins = np.diff(wall.astype(np.int8), axis=0, prepend=0) == 1  # the first cell of every wall
    ahead = begins.sum(0, keepdims=True) - begins.cumsum(0)
    return inside & (ahead % 2 == 1)
