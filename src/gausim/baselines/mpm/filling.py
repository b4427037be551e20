"""Interior filling: Gaussians lie on the surface of an object, matter also lies within it (PhysGaussian)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import njit
from torch import Tensor

from gausim.baselines.mpm.config import Grid
from gausim.core import ConfigError
from gausim.kernels.announce import announced
from gausim.kernels.jit import KERNEL

REACH = 3.0  # standard deviations over which a Gaussian is splatted


@dataclass(frozen=True)
class Filling:
    """How the interior is found and filled.

    Attributes:
        cells: cells per axis of the grid of density.
        dense: density from which a cell is matter and topped up with particles.
        wall: density from which a cell stops a ray.
        per_cell: particles in a filled cell.
        ray_axis: axis along which crossings of walls are counted; odd means inside.
        open_side: side on which no wall is asked for, as (axis, +1 or -1), e.g. (2, -1) for an object that was not
            seen from below; None asks for walls all round.
        seed: of the particles' places within their cells.
    """

    cells: int = 50
    dense: float = 5.0
    wall: float = 3.0
    per_cell: int = 8
    ray_axis: int = 0
    open_side: tuple[int, int] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.ray_axis not in (0, 1, 2):
            raise ConfigError(f"ray_axis: expected 0, 1 or 2, got {self.ray_axis}.")
        if self.open_side is not None and self.open_side[0] == self.ray_axis and self.open_side[1] > 0:
            raise ConfigError(
                f"open_side: {self.open_side} has no wall, so no ray can be cast through it. Change ray_axis."
            )


def fill_interior(
    means: Float[Tensor, "K 3"],
    covars: Float[Tensor, "K 3 3"],
    opacities: Float[Tensor, " K"],
    domain: Grid,
    options: Filling,
) -> Float[Tensor, "M 3"]:
    """Positions of particles that fill dense and enclosed cells; they carry no appearance [simulation units].

    The density of a cell is the sum of opacity exp(-d^T S^-1 d / 2) at its centre. Cells denser than ``dense`` are
    topped up to ``per_cell``. A cell without particle is inside if rays along the axes meet a wall in every direction
    and the ray along ``ray_axis`` meets an odd number of them.

    Args:
        means: particles that are there already [simulation units].
        covars: their covariances [simulation units^2].
        opacities: their opacities in [0, 1].
        domain: the domain; its cells are of no account.
        options: thresholds.
    """
    grid = Grid(options.cells, domain.size)
    density = splat_density(means, covars, opacities, grid)
    count = _particles_per_cell(means, grid)
    inside = (count == 0) & enclosed(density > options.wall, options)
    wanted = np.where((density > options.dense) | inside, options.per_cell, 0)
    missing = np.maximum(wanted - count, 0)
    cells = np.repeat(np.argwhere(missing > 0), missing[missing > 0], axis=0)
    places = (cells + np.random.default_rng(options.seed).random(cells.shape)) * grid.dx
    return torch.from_numpy(places).to(means)


def splat_density(
    means: Float[Tensor, "K 3"], covars: Float[Tensor, "K 3 3"], opacities: Float[Tensor, " K"], grid: Grid
) -> Float[np.ndarray, "n n n"]:
    """Sum of opacity exp(-d^T S^-1 d / 2) at the cell centres, each Gaussian up to 3 of its greatest deviations."""
    eigenvalues, axes = np.linalg.eigh(covars.detach().cpu().double().numpy())
    # The radius is made of eigenvalues of S. (Of S^-1 they would make thin Gaussians cover the whole grid.)
    eigenvalues = np.maximum(eigenvalues, 1e-12 * grid.size**2)
    precision = np.einsum("kij,kj,klj->kil", axes, 1 / eigenvalues, axes)
    radius = REACH * np.sqrt(eigenvalues[:, -1])
    density = np.zeros((grid.cells,) * 3)
    with announced("interior filling"):
        _splat(
            means.detach().cpu().double().numpy(),
            precision,
            radius,
            opacities.detach().cpu().double().numpy(),
            grid.dx,
            density,
        )
    return density


@njit(**KERNEL)
def _splat(means, precision, radius, opacities, dx, density):  # type: ignore[no-untyped-def]
    """Adds every Gaussian to the cells within its radius."""
    n = density.shape[0]
    for k in range(means.shape[0]):
        x = means[k]
        low = [max(0, int(np.floor((x[a] - radius[k]) / dx))) for a in range(3)]
        high = [min(n - 1, int(np.floor((x[a] + radius[k]) / dx))) for a in range(3)]
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for m in range(low[2], high[2] + 1):
                    u, v, w = (i + 0.5) * dx - x[0], (j + 0.5) * dx - x[1], (m + 0.5) * dx - x[2]
                    p = precision[k]
                    square = p[0, 0] * u * u + p[1, 1] * v * v + p[2, 2] * w * w
                    square += 2 * (p[0, 1] * u * v + p[0, 2] * u * w + p[1, 2] * v * w)
                    density[i, j, m] += opacities[k] * np.exp(-0.5 * square)


def enclosed(wall: Bool[np.ndarray, "n n n"], options: Filling) -> Bool[np.ndarray, "n n n"]:
    """Cells that have walls in all directions along the axes and an odd number of them along one ray."""
    inside = np.ones_like(wall)
    for axis in range(3):
        for side in (1, -1):
            if options.open_side != (axis, side):
                inside &= np.flip(_seen(np.flip(wall, axis), axis), axis) if side > 0 else _seen(wall, axis)
    begins = wall.copy()  # cells where a wall begins, for a ray that goes up the axis
    upper = [slice(None)] * 3
    lower = [slice(None)] * 3
    upper[options.ray_axis], lower[options.ray_axis] = slice(1, None), slice(None, -1)
    begins[tuple(upper)] &= ~wall[tuple(lower)]
    total = begins.sum(options.ray_axis, keepdims=True)
    beyond = total - begins.cumsum(options.ray_axis)
    return inside & (beyond % 2 == 1)


def _seen(wall: Bool[np.ndarray, "n n n"], axis: int) -> Bool[np.ndarray, "n n n"]:
    """Cells at or above the first wall along an axis."""
    return np.logical_or.accumulate(wall, axis)


def _particles_per_cell(means: Float[Tensor, "K 3"], grid: Grid) -> Int[np.ndarray, "n n n"]:
    cells = np.floor(means.detach().cpu().double().numpy() / grid.dx).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < grid.cells)).all(1)]
    flat = np.ravel_multi_index(tuple(cells.T), (grid.cells,) * 3)
    return np.bincount(flat, minlength=grid.cells**3).reshape((grid.cells,) * 3)
