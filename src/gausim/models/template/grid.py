"""A regular grid of quadratic B-splines around the kernels, and linear elasticity on it.

The finite cell method (Parvizian, Duester and Rank 2007) needs no mesh of a body: elastic energy is integrated over
small cells, those inside the body with weight 1 and those just around it with weight 0.01, which keeps the equations
well posed.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy import ndimage

# Stiffness of the cells around the body, as a fraction of that of cells inside.
OUTSIDE = 0.01
# Integration cells per grid spacing.
SUBDIVISIONS = 2
# Poisson's ratio. Rubber and plant tissue are nearly incompressible; 0.3 avoids locking of quadratic splines.
POISSON = 0.3
# Lame's parameters at Young's modulus 1.
FIRST, SECOND = POISSON / ((1 + POISSON) * (1 - 2 * POISSON)), 1 / (2 * (1 + POISSON))
# Tolerance for rounding, as a fraction of an integration cell: the outermost kernels lie on the border of theirs.
ROUNDING = 1e-6
# Grid points within the support of a quadratic B-spline, along one axis.
SUPPORT = 3


def rigid_motions(offset: np.ndarray) -> np.ndarray:
    """Displacements (P, 3, 6) of points at ``offset`` (P, 3) by translations along and rotations about the axes."""
    translations = np.broadcast_to(np.eye(3), (len(offset), 3, 3))
    return np.concatenate((translations, np.stack([np.cross(axis, offset) for axis in np.eye(3)], -1)), -1)


def by_component(motions: np.ndarray) -> np.ndarray:
    """Displacements (P, 3, C) component by component, (3 P, C)."""
    return motions.transpose(1, 0, 2).reshape(-1, motions.shape[-1])


@dataclass(frozen=True)
class Grid:
    """A regular grid of quadratic B-splines."""

    origin: np.ndarray  # corner of the first node's cell [scene units]
    spacing: float  # between nodes [scene units]
    shape: tuple[int, int, int]  # nodes along each axis

    @property
    def size(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.shape))

    def rigid_coefficients(self) -> np.ndarray:
        """Coefficients (3 nodes, 6) of the translations along and rotations about the axes: exact in splines."""
        place = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), -1).reshape(-1, 3) * self.spacing
        return by_component(rigid_motions(place - place.mean(0)))

    def splines(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Nodes (P, 27), weights (P, 27) and their derivatives (P, 27, 3) [1 / scene units] at points (P, 3)."""
        place = (points - self.origin) / self.spacing
        first = np.floor(place - 0.5).astype(np.int64)
        x = place - first
        weight = np.stack((0.5 * (1.5 - x) ** 2, 0.75 - (x - 1) ** 2, 0.5 * (x - 0.5) ** 2), -1)
        slope = np.stack((x - 1.5, 2 - 2 * x, x - 0.5), -1) / self.spacing
        steps = np.stack(np.meshgrid(*[np.arange(SUPPORT)] * 3, indexing="ij"), -1).reshape(-1, 3)
        nodes = np.ravel_multi_index(tuple(np.moveaxis(first[:, None] + steps, -1, 0)), self.shape)
        axes = np.arange(3)
        factors = weight[:, axes, steps]  # (P, 27, 3)
        slopes = slope[:, axes, steps]
        gradients = np.stack([slopes[..., a] * np.delete(factors, a, -1).prod(-1) for a in range(3)], -1)
        return nodes, factors.prod(-1), gradients


def matrix(nodes: np.ndarray, values: np.ndarray, size: int) -> sp.csr_matrix:
    """Sparse (P, size) matrix with ``values`` (P, 27) at ``nodes`` (P, 27)."""
    rows = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    return sp.csr_matrix((values.ravel(), (rows, nodes.ravel())), shape=(len(nodes), size))


def inside(occupied: np.ndarray) -> np.ndarray:
    """Cells of the body: cells with kernels and cells enclosed by kernels along at least two axes."""
    margin = 2
    padded = np.pad(occupied, margin)
    closed = ndimage.binary_closing(padded, iterations=margin)[(slice(margin, -margin),) * 3] | occupied
    enclosed = np.zeros(occupied.shape, dtype=np.int64)
    for axis in range(3):
        before = np.maximum.accumulate(closed, axis=axis)
        after = np.flip(np.maximum.accumulate(np.flip(closed, axis), axis=axis), axis)
        enclosed += before & after
    return occupied | ndimage.binary_fill_holes(closed) | (enclosed >= 2)


def cells(points: np.ndarray, spacing: float) -> tuple[Grid, np.ndarray, np.ndarray]:
    """The grid around kernels (K, 3), centres (Q, 3) and weights (Q,) of the integration cells."""
    border = 3
    origin = points.min(0) - border * spacing
    extent = points.max(0) - origin
    shape = np.ceil(extent / spacing).astype(np.int64) + border + 1
    grid = Grid(origin, spacing, (int(shape[0]), int(shape[1]), int(shape[2])))
    small = spacing / SUBDIVISIONS
    occupied = np.zeros(np.ceil(extent / small).astype(np.int64) + 2 * SUBDIVISIONS, dtype=bool)
    occupied[tuple(np.floor((points - origin) / small + ROUNDING).astype(np.int64).T)] = True
    occupied = inside(occupied)
    near = ndimage.binary_dilation(occupied, iterations=SUBDIVISIONS)
    centres = (np.argwhere(near) + 0.5) * small + origin
    return grid, centres, np.where(occupied[near], 1.0, OUTSIDE) * small**3


def stiffness(grid: Grid, centres: np.ndarray, weights: np.ndarray) -> list[list[sp.spmatrix]]:
    """Blocks [a][b] of linear isotropic elasticity with Young's modulus 1."""
    nodes, _, gradients = grid.splines(centres)
    slopes = [matrix(nodes, gradients[..., a], grid.size) for a in range(3)]
    weight = sp.diags(weights)
    laplace = SECOND * sum(s.T @ weight @ s for s in slopes)
    nothing = sp.csr_matrix(laplace.shape)
    return [
        [
            FIRST * slopes[a].T @ weight @ slopes[b]
            + SECOND * slopes[b].T @ weight @ slopes[a]
            + (laplace if a == b else nothing)
            for b in range(3)
        ]
        for a in range(3)
    ]
