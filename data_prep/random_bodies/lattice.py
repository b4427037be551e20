"""From a scalar field to a body: cells of a regular grid, snapped to the surface, warped, pinned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from data_prep.random_bodies.shapes import Field, Rng
from data_prep.synthetic.bodies import CORNERS, Body, Ints, tet_volumes

EXTENT, FINEST = 1.04, 30  # half of the grid's edge; most cells along it
SNAP, STEPS = 0.42, 3  # farthest that a node moves to the surface [cells]; Newton steps
# Least volume of a tetrahedron: of a sixth of a cell where nodes are snapped, of the mean after the warp.
SNAPPED_VOLUME, WARPED_VOLUME = 0.3, 0.15
PINS = ("bottom", "side", "ends", "patch")
MOST_PINNED = 0.35  # of the cells


def body_of(field: Field, least_cells: int) -> Body | None:
    """The coarsest body of at least so many cells; the finest one, or None where it is hardly there.

    Its nodes lie in [-1, 1]^3; nothing is held.
    """
    for count in range(8, FINEST + 1):
        edge = 2 * EXTENT / count
        axis = (np.arange(count) + 0.5) * edge - EXTENT
        inside = field(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)) > 0
        labels, found = ndimage.label(inside.reshape(count, count, count))
        if not found:
            continue
        sizes = np.bincount(labels.ravel())[1:]
        if sizes.max() >= least_cells or (count == FINEST and sizes.max() >= least_cells / 3):
            return _snapped(np.argwhere(labels == 1 + sizes.argmax()), edge, field)
    return None


def _snapped(grid: Ints, edge: float, field: Field) -> Body:
    nodes, inverse = np.unique((grid[:, None] + CORNERS).reshape(-1, 3), axis=0, return_inverse=True)
    body = Body(nodes * edge - EXTENT, inverse.reshape(-1, 8), grid, np.zeros(len(nodes), bool))
    outer = np.flatnonzero(np.bincount(body.cells.ravel()) < 8)
    moved, h = body.nodes.copy(), 0.05 * edge
    for _ in range(STEPS):
        x = moved[outer]
        slope = np.stack([field(x + h * e) - field(x - h * e) for e in np.eye(3)], 1) / (2 * h)
        step = -(field(x) / np.maximum((slope**2).sum(1), 1e-6))[:, None] * slope
        length = np.linalg.norm(step, axis=1, keepdims=True)
        x = x + step * np.minimum(1, 0.5 * SNAP * edge / np.maximum(length, 1e-12))
        moved[outer] = body.nodes[outer] + np.clip(x - body.nodes[outer], -SNAP * edge, SNAP * edge)
    tetrahedra = body.tetrahedra
    while True:
        bad = tet_volumes(moved, tetrahedra).reshape(6, -1).min(0) < SNAPPED_VOLUME * edge**3 / 6
        if not bad.any():
            return replace(body, nodes=moved)
        moved[body.cells[bad]] = body.nodes[body.cells[bad]]


def warped(body: Body, diagonal: float, rng: Rng) -> Body:
    """The body stretched, bent and twisted, standing on z = 0 with the given diagonal of its bounding box."""
    stretch, bend, twist = rng.uniform(-0.35, 0.35, 3), rng.uniform(-0.4, 0.4, 2), rng.uniform(-0.8, 0.8)
    tetrahedra, strength = body.tetrahedra, 1.0
    while True:
        x, y, z = (body.nodes * np.exp(strength * stretch)).T
        angle = strength * twist * z
        x, y = x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)
        nodes = np.stack((x + strength * bend[0] * z**2, y + strength * bend[1] * z**2, z), 1)
        volumes = tet_volumes(nodes, tetrahedra)
        if volumes.min() > WARPED_VOLUME * volumes.mean() or strength < 0.1:
            nodes *= diagonal / np.linalg.norm(np.ptp(nodes, axis=0))
            return replace(body, nodes=nodes - [*nodes.mean(0)[:2], nodes[:, 2].min()])
        strength *= 0.6


def pinned(body: Body, kind: str, rng: Rng) -> Body | None:
    """The body with all corners of some cells held; None where that would be nearly all or next to nothing."""
    middle = body.nodes[body.cells].mean(1)
    low, high = middle.min(0), middle.max(0)
    part = rng.uniform(0.03, 0.12)
    if kind == "patch":
        place = body.nodes[rng.integers(len(body.nodes))]
        held = np.linalg.norm(middle - place, axis=1) < rng.uniform(0.1, 0.22) * body.diagonal
    else:
        axis = {"bottom": 2, "side": int(rng.integers(3)), "ends": int((high - low).argmax())}[kind]
        along = (middle[:, axis] - low[axis]) / (high - low)[axis]
        if kind == "side" and rng.random() < 0.5:
            along = 1 - along
        held = (along < part) | (along > 1 - part) if kind == "ends" else along < part
    if not 2 <= held.sum() <= MOST_PINNED * len(middle):
        return None
    nodes = np.zeros(len(body.nodes), bool)
    nodes[body.cells[held]] = True
    return replace(body, held=nodes)
