"""Gaussians in the cells of a body: where they lie, how they look, and where a motion of the nodes takes them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_prep.common.spread import farthest
from data_prep.synthetic.bodies import CORNERS, Array, Body, Ints
from gausim.core import GaussianScene
from gausim.ops.spherical_harmonics import C0, C1

OPACITY_LOGIT = 2.6  # opacity 0.93
TANGENT_SCALE = 0.62  # of the kernel spacing: neighbours overlap without washing out the texture
NORMAL_SCALE = 0.18
GLOSS = 0.1  # a kernel seen face on is this much brighter than one seen edge on
CANDIDATES = 8  # points per kernel among which an even covering is chosen


@dataclass(frozen=True, eq=False)
class Embedding:
    """K points fixed in the cells of a body."""

    body: Body  # the body
    cell: Ints  # (K,) cell of each point
    local: Array  # (K, 3) trilinear coordinates in [0, 1] within it

    @cached_property
    def _weights(self) -> Array:
        """(K, 8) of the cell's corners."""
        return np.prod(self._factors, axis=-1)

    @cached_property
    def _factors(self) -> Array:
        return np.where(CORNERS == 1, self.local[:, None], 1 - self.local[:, None])

    @cached_property
    def _slopes(self) -> Array:
        """(K, 8, 3) derivatives of the weights by the rest position."""
        return self._local_slopes @ np.linalg.inv(self.jacobian)

    @cached_property
    def _local_slopes(self) -> Array:
        """(K, 8, 3) derivatives of the weights by the trilinear coordinates."""
        factors, sign = self._factors, 2.0 * CORNERS - 1
        return np.stack([np.prod(np.delete(factors, a, -1), -1) * sign[:, a] for a in range(3)], -1)

    @cached_property
    def jacobian(self) -> Array:
        """(K, 3, 3) derivatives of the rest position by the trilinear coordinates."""
        return np.einsum("kca,kcx->kxa", self._local_slopes, self.body.nodes[self.body.cells[self.cell]])

    def positions(self, nodes: Array) -> Array:
        """(..., K, 3) positions of the points when the nodes are at (..., N, 3)."""
        return np.einsum("kc,...kcx->...kx", self._weights, nodes[..., self.body.cells[self.cell], :])

    def deformation_gradients(self, nodes: Array) -> Array:
        """(..., K, 3, 3) deformation gradients at the points."""
        return np.einsum("...kcx,kca->...kxa", nodes[..., self.body.cells[self.cell], :], self._slopes)

    def held(self) -> NDArray[np.bool_]:
        """(K,) points that no motion can move: all corners of their cell are held."""
        return np.all(self.body.held[self.body.cells[self.cell]], axis=-1)


def cover_surface(body: Body, count: int, rng: np.random.Generator) -> tuple[Embedding, Array, float]:
    """Spreads points evenly over the outside of a body, its underside excepted.

    Returns:
        The points, their (K, 3, 3) frames (columns: two tangents and the outward normal), and their spacing.
    """
    cell, axis, side = _outer_faces(body)
    # Many candidates, uniform per area, thinned to the farthest ones.
    center = np.full((len(cell), 3), 0.5)
    center[np.arange(len(cell)), axis] = side
    area = np.linalg.norm(_area_vector(Embedding(body, cell, center), axis, side), axis=1)
    pick = rng.choice(len(cell), size=CANDIDATES * count, p=area / area.sum())
    local = rng.random((len(pick), 3))
    local[np.arange(len(pick)), axis[pick]] = side[pick]
    points = Embedding(body, cell[pick], local)
    normal = _area_vector(points, axis[pick], side[pick])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    x = points.positions(body.nodes)
    seen = np.flatnonzero(~((normal[:, 2] < -0.9) & (x[:, 2] < 1e-6)))
    chosen = seen[farthest(x[seen], count)]
    tangent = np.cross(normal[chosen], np.where(np.abs(normal[chosen, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frames = np.stack((tangent, np.cross(normal[chosen], tangent), normal[chosen]), -1)
    return Embedding(body, points.cell[chosen], local[chosen]), frames, float(np.sqrt(area.sum() / count))


def embedded_scene(points: Embedding, frames: Array, spacing: float, colors: Array, *, name: str) -> GaussianScene:
    """The rest scene: flat Gaussians along the surface, slightly glossy (SH degree 1), the held ones pinned."""
    count, normal = len(points.cell), frames[..., 2]
    scales = spacing * np.array([TANGENT_SCALE, TANGENT_SCALE, NORMAL_SCALE])
    sh = np.zeros((count, 4, 3))
    sh[:, 0] = (colors - 0.5) / C0
    # The basis is (-C1 y, C1 z, -C1 x) at the direction away from the camera; this adds -GLOSS (direction . normal).
    sh[:, 1:] = (GLOSS / C1 * normal[:, [1, 2, 0]] * [1.0, -1.0, 1.0])[..., None]
    quats = Rotation.from_matrix(frames).as_quat(scalar_first=True)
    return GaussianScene.create(
        means=torch.from_numpy(points.positions(points.body.nodes)).float(),
        log_scales=torch.from_numpy(np.tile(np.log(scales), (count, 1))).float(),
        quats=torch.from_numpy(quats).float(), opacity_logits=torch.full((count,), OPACITY_LOGIT),
        sh=torch.from_numpy(sh).float(), pinned=torch.from_numpy(points.held()), name=name,
    )  # fmt: skip


def _outer_faces(body: Body) -> tuple[Ints, Ints, Array]:
    """Cell, axis and side (0 or 1) of every cell face without a neighbour."""
    place = body.grid - body.grid.min(0) + 1
    solid = np.zeros(place.max(0) + 2, bool)
    solid[tuple(place.T)] = True
    beside = place[:, None, None] + np.eye(3, dtype=int)[:, None] * np.array([[-1], [1]])  # (C, axis, side, 3)
    cell, axis, side = np.nonzero(~solid[tuple(np.moveaxis(beside, -1, 0))])
    return cell, axis, side.astype(float)


def _area_vector(points: Embedding, axis: Ints, side: Array) -> Array:
    """Outward normal times area element, at points on the faces of their cells across ``axis``."""
    row = np.arange(len(points.cell))
    vector = np.cross(points.jacobian[row, :, (axis + 1) % 3], points.jacobian[row, :, (axis + 2) % 3])
    return vector * (2 * side - 1)[:, None]
