"""Shapes of the synthetic set: lattices of hexahedral cells bent into a pudding, a flower, a jelly and a bar.

A lattice is a list of unit cubes on an integer grid; a smooth map takes its nodes to the rest shape. The same cells
carry the finite elements (split into tetrahedra) and the Gaussians (by trilinear coordinates within a cell).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Corner c of a cell has the bits (c >> 2, c >> 1, c) & 1 along its three axes.
CORNERS = np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)])
# Kuhn's split of a cube into six tetrahedra along its long diagonal; neighbouring cubes fit together.
_PATHS = ((4, 2, 1), (4, 1, 2), (2, 4, 1), (2, 1, 4), (1, 4, 2), (1, 2, 4))


def tet_volumes(nodes: Array, tetrahedra: Ints) -> Array:
    """Signed volumes (..., T) of tetrahedra (T, 4) of nodes (..., N, 3)."""
    x = nodes[..., tetrahedra, :]
    return np.linalg.det(x[..., 1:, :] - x[..., :1, :]) / 6


@dataclass(frozen=True, eq=False)
class Body:
    """A rest shape."""

    nodes: Array  # (N, 3) rest positions [scene units], z up
    cells: Ints  # (C, 8) node numbers of each cell's corners
    grid: Ints  # (C, 3) integer position of each cell in the lattice
    held: NDArray[np.bool_]  # (N,) nodes that nothing but a hand moves

    @property
    def tetrahedra(self) -> Ints:
        """(6 C, 4) node numbers, positively oriented."""
        corners = [[0, p[0], p[0] + p[1], 7] for p in _PATHS]
        tets = np.concatenate([self.cells[:, c] for c in corners])
        negative = tet_volumes(self.nodes, tets) < 0
        tets[negative] = tets[negative][:, [0, 2, 1, 3]]
        return tets

    def least_volume(self, positions: Array) -> float:
        """Smallest volume of an element over that at rest, at node positions (..., N, 3); below 0 it is inside out."""
        tets = self.tetrahedra
        return float((tet_volumes(positions, tets) / tet_volumes(self.nodes, tets)).min())

    @property
    def diagonal(self) -> float:
        """Length of the bounding-box diagonal [scene units]."""
        return float(np.linalg.norm(np.ptp(self.nodes, axis=0)))


def pudding() -> Body:
    """A tapered block with rounded sides on a plate: 1.1 wide, 0.8 high; the lowest tenth is held."""
    count, heights = 5, np.array([0.0, 0.1, 0.325, 0.55, 0.775, 1.0])
    cells = [(i, j, k) for i in range(count) for j in range(count) for k in range(len(heights) - 1)]

    def shape(grid: Array) -> Array:
        u, v = 2 * grid[:, 0] / count - 1, 2 * grid[:, 1] / count - 1
        w = heights[grid[:, 2].astype(int)]
        radius = 0.55 - 0.13 * w - 0.05 * w**6  # tapered, its upper rim rounded
        x, y = _round_square(u, v, 0.7)
        dome = 0.06 * w**2 * (1 - 0.5 * (u * u + v * v))
        return np.stack((radius * x, 0.92 * radius * y, 0.74 * w + dome), 1)

    return _body(cells, shape, held_layers=2)


def flower() -> Body:
    """A curved stem with a leaf and a tilted five-petalled blossom, 1.1 high; the foot of the stem is held."""
    stem, half = 7, 2.5
    cells = [(2, 2, k) for k in range(stem)] + [(3, 2, 3), (4, 2, 3)]
    cells += [(i, j, stem) for i in range(5) for j in range(5)]
    heights = np.concatenate(([0.0, 0.1], 0.1 + 0.8 * np.arange(1, stem) / (stem - 1)))

    def shape(grid: Array) -> Array:
        i, j, k = grid.T
        is_blossom = k >= stem
        z = heights[np.minimum(k, stem).astype(int)]
        leaf = np.maximum(i - 3.0, 0.0) * ~is_blossom  # how far out along the leaf
        wide = np.where(is_blossom, 0.16, 0.19 - 0.02 * z)
        x, y = wide * (i - half), wide * (j - half)
        middle = heights[3] + 0.5 * (heights[4] - heights[3])
        z_stem = np.where(leaf > 0, middle + (z - middle) * (1 - 0.38 * leaf) + 0.09 * leaf, z)
        y = np.where(leaf > 0, y * (1.5 - 0.5 * leaf), y)
        u, v = _round_square((i - half) / half, (j - half) / half, 0.9)
        radius, angle = np.hypot(u, v), np.arctan2(v, u)
        petals = 1 + 0.25 * np.clip(2 * radius - 0.8, 0, 1) * np.cos(5 * angle)
        up = 0.12 * (k - stem) * (1 - 0.4 * radius) + 0.12 * radius**2
        tilt = 0.4
        bx, by = 0.4 * petals * u, 0.4 * petals * v
        blossom = np.stack((bx * np.cos(tilt) + up * np.sin(tilt), by, z + up * np.cos(tilt) - bx * np.sin(tilt)), 1)
        rest = np.where(is_blossom[:, None], blossom, np.stack((x, y, z_stem), 1))
        rest[:, 0] += 0.1 * np.sin(2.2 * z)  # the curve of the stem, which the blossom rides on
        return rest

    return _body(cells, shape, held_layers=2)


# The potted flower: column of its stem, cells across its disc and along a petal, and the layer of its blossom.
STEM, DISC, PETAL, TOP = 2, 5, 3, 8


def potted() -> Body:
    """A flower with twelve separate petals and two leaves in a pot, 1.5 high; the pot is held."""
    cells = [(i, j, k) for i in range(1, 4) for j in range(1, 4) for k in range(2)]  # the pot
    cells += [(STEM, STEM, k) for k in range(2, TOP)]
    cells += [(STEM + s, STEM, k) for s, k in ((1, 4), (2, 4), (-1, 5), (-2, 5))]  # the leaves
    cells += [(i, j, TOP) for i in range(DISC) for j in range(DISC)]
    ends = [(i, j) for i in (0, 2, 4) for out in range(1, PETAL + 1) for j in (-out, DISC - 1 + out)]
    cells += [(i, j, TOP) for i, j in ends] + [(j, i, TOP) for i, j in ends]

    def shape(grid: Array) -> Array:
        k = grid[:, 2]
        rest = np.where((k <= 2)[:, None], _pot(grid), _stem_and_leaves(grid))
        rest[k >= TOP] = _blossom(grid[k >= TOP])
        return rest

    return _body(cells, shape, held_layers=3)


def _pot(grid: Array) -> Array:
    u, v = np.clip((grid[:, :2] - 2.5) / 1.5, -1, 1).T
    x, y = _round_square(u, v, 1.0)
    radius = 0.17 + 0.03 * grid[:, 2]
    return np.stack((radius * x, radius * y, 0.15 * grid[:, 2]), 1)


def _stem_and_leaves(grid: Array) -> Array:
    aside, across = grid[:, 0] - 2.5, grid[:, 1] - 2.5
    height = (grid[:, 2] - 2) / (TOP - 2)
    wide = 0.12 - 0.035 * height
    out = np.maximum(np.abs(aside) - 0.5, 0.0)  # how far along a leaf
    x = 0.09 * np.sin(2.4 * height) + wide * np.clip(aside, -0.5, 0.5) + np.sign(aside) * 0.14 * out
    y = across * np.where(out > 0, 0.15 - 0.045 * (out - 1) ** 2, wide)
    z = 0.3 + 0.9 * height
    centre = 0.3 + 0.9 * np.where(aside > 0, 2.5, 3.5) / (TOP - 2)
    leaf = centre + (z - centre) * (1 - 0.32 * out) + 0.1 * out - 0.02 * out**2
    return np.stack((x, y, np.where(out > 0, leaf, z)), 1)


def _blossom(grid: Array) -> Array:
    half, tilt = DISC / 2, 0.75
    u, v = (grid[:, :2] - half).T / half
    out = np.maximum(np.maximum(np.abs(u), np.abs(v)) - 1, 0.0) * half  # layers of cells beyond the disc
    x, y = _round_square(np.clip(u, -1, 1), np.clip(v, -1, 1), 1.0)
    # Petals stand in columns of a side, at [-1, -0.6], [-0.2, 0.2] and [0.6, 1], and point 30 degrees apart.
    along_x = np.abs(u) > np.abs(v)
    side, turn = np.where(along_x, v, u), np.where(along_x, np.sign(u), -np.sign(v))
    column = np.clip(np.round(side / 0.8), -1, 1)
    ahead = np.arctan2(np.where(along_x, 0.0, np.sign(v)), np.where(along_x, np.sign(u), 0.0))
    angle, length = ahead + turn * column * np.pi / 6, out / PETAL
    width = 0.034 + 0.05 * np.sin(np.pi * np.minimum(0.12 + 0.72 * length, 1.0)) * (1 - 0.75 * length**4)
    across, radius = np.clip((side - 0.8 * column) / 0.2, -1, 1) * turn * width, 0.13 + 0.27 * length
    beyond = out > 0
    bx = np.where(beyond, radius * np.cos(angle) - across * np.sin(angle), 0.13 * x)
    by = np.where(beyond, radius * np.sin(angle) + across * np.cos(angle), 0.13 * y)
    rise = np.maximum(np.hypot(bx, by) - 0.1, 0)
    bz = (grid[:, 2] - TOP) * np.where(beyond, 0.055 - 0.02 * length, 0.09) + 0.55 * rise - 0.8 * rise**2
    x = 0.09 * np.sin(2.4) + bx * np.cos(tilt) + bz * np.sin(tilt)
    return np.stack((x, by, 1.2 + bz * np.cos(tilt) - bx * np.sin(tilt)), 1)


def jelly() -> Body:
    """A lopsided block with rounded sides, 1 wide and 0.8 high, its lowest point 0.45 above z = 0; nothing is held."""
    count = 5
    cells = [(i, j, k) for i in range(count) for j in range(count) for k in range(count)]

    def shape(grid: Array) -> Array:
        u, v, w = (2 * grid / count - 1).T
        x, y = _round_square(u, v, 0.5)
        narrow = 1 - 0.16 * w - 0.08 * u * w  # tapered, more so on one side
        bump = 0.06 * np.exp(-((u - 0.5) ** 2 + (v - 0.4) ** 2) / 0.3) * (w + 1)
        return np.stack((0.5 * narrow * x, 0.44 * narrow * (y + 0.12 * x), 0.81 + 0.36 * w + bump), 1)

    return _body(cells, shape, held_layers=0)


def bar() -> Body:
    """A bar along x with a thick head beside its middle, 1.6 long; two layers of cells at either end are held."""
    length, across = 16, 3
    cells = [(i, j, k) for i in range(length) for j in range(across) for k in range(across)]

    def shape(grid: Array) -> Array:
        along = 2 * grid[:, 0] / length - 1
        v, w = (2 * grid[:, 1:] / across - 1).T
        y, z = _round_square(v, w, 0.6)
        head = np.exp(-(((along - 0.12) / 0.26) ** 4))
        half = 0.1 + 0.13 * head
        return np.stack((0.8 * along, half * y, 0.8 + half * (z + 0.25 * head)), 1)

    whole = _body(cells, shape, held_layers=0)
    return replace(whole, held=np.abs(whole.nodes[:, 0]) > 0.8 * (1 - 4 / length) - 1e-6)


BODIES: dict[str, Callable[[], Body]] = {
    "pudding": pudding, "flower": flower, "potted": potted, "jelly": jelly, "bar": bar,
}  # fmt: skip


def _round_square(u: Array, v: Array, roundness: float) -> tuple[Array, Array]:
    """Maps the square [-1, 1]^2 towards the unit disc: roundness 0 keeps it, 1 gives the disc."""
    return u * np.sqrt(1 - 0.5 * roundness * v * v), v * np.sqrt(1 - 0.5 * roundness * u * u)


def _body(cells: list[tuple[int, int, int]], shape: Callable[[Array], Array], *, held_layers: int) -> Body:
    grid = np.array(sorted(cells))
    nodes, inverse = np.unique((grid[:, None] + CORNERS).reshape(-1, 3), axis=0, return_inverse=True)
    return Body(
        nodes=shape(nodes.astype(float)),
        cells=inverse.reshape(-1, 8),
        grid=grid,
        # Two layers of held nodes make the lowest cells rigid: Gaussians in them are pinned, exactly.
        held=nodes[:, 2] < held_layers,
    )
