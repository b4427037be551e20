"""Surfaces: read from OBJ and PLY files, brought to their place, refined, painted, with true points for the simulation.

Of a file only triangles and polygons are read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_prep.common.spread import farthest
from gausim.core import ConfigError, DataError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# The largest extent of every object [scene units]; forces and lights are made for it.
SIZE = 2.0
# Longest edge, as a fraction of the diagonal: the surface bends and carries its paint at its vertices only.
LONGEST_EDGE = 0.03
MOST_TRIANGLES = 2_000_000
UP_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Mesh:
    """A surface.

    Attributes:
        vertices: positions (V, 3), finite, in the file's own units and axes.
        triangles: vertex indices (T, 3), each in 0..V-1; T > 0.
    """

    vertices: Array
    triangles: Indices


def read_mesh(path: Path) -> Mesh:
    """Reads an OBJ or PLY file; polygons become fans of triangles (right for convex ones)."""
    try:
        import trimesh
    except ImportError as error:
        raise ConfigError("trimesh reads meshes. Install it: `pip install 'gausim[synth]'`.") from error
    if not path.is_file() or path.suffix.lower() not in (".obj", ".ply"):
        raise DataError(f"{path}: no such file in OBJ or PLY format. Convert the mesh first.")
    try:
        # As they stand in the file, without materials, which would split vertices.
        found: Any = trimesh.load(path, process=False, maintain_order=True, skip_materials=True, force="mesh")
        vertices, triangles = np.array(found.vertices, np.float64), np.array(found.faces, np.int64)
    except Exception as error:  # its readers raise many kinds of exceptions on damaged files
        raise DataError(f"{path}: cannot be read as a mesh ({error!s:.120}). Export it again, as triangles.") from error
    triangles = np.where(triangles < 0, triangles + len(vertices), triangles)
    if not len(triangles) or not np.isfinite(vertices).all():
        raise DataError(f"{path}: has {len(vertices)} vertices and {len(triangles)} faces, expected finite ones.")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise DataError(f"{path}: a face uses a vertex that is not there, of {len(vertices)}. Export the mesh again.")
    return Mesh(vertices, triangles)


@dataclass(frozen=True)
class Surface:
    """A painted surface with z up that stands on z = 0, centred on x = y = 0, its largest extent 2 units."""

    vertices: np.ndarray  # positions (V, 3) [scene units], float32
    faces: np.ndarray  # triangles (T, 3) of vertex indices, int32
    albedo_linear: np.ndarray  # linear RGB (V, 3) in 0..1, float16
    gt_ids: np.ndarray  # indices (P,) of the vertices whose true motion is stored, int32

    @property
    def diagonal(self) -> float:
        """Of the bounding box [scene units]."""
        return float(np.linalg.norm(np.ptp(self.vertices.astype(np.float64), axis=0)))


def make_surface(mesh: Mesh, path: Path, *, up: str, points: int, seed: int) -> Surface:
    """Brings a mesh to its place, refines it where its edges are long, and paints it."""
    placed = _placed(_tidy(mesh, path), path, up)
    longest = LONGEST_EDGE * float(np.linalg.norm(np.ptp(placed.vertices, axis=0)))
    fine = refine(placed, longest, path)
    vertices = fine.vertices.astype(np.float32)
    colours = paint(fine.vertices, np.random.default_rng([seed, 1]))
    return Surface(
        vertices, fine.triangles.astype(np.int32), colours.astype(np.float16),
        farthest_points(fine.vertices, points).astype(np.int32),
    )  # fmt: skip


def _tidy(mesh: Mesh, path: Path) -> Mesh:
    """Without triangles of no area and without vertices of no triangle."""
    with np.errstate(over="ignore", invalid="ignore"):
        extent = np.ptp(mesh.vertices, axis=0).max()
        scaled = (mesh.vertices - mesh.vertices.min(0)) / extent if extent > 0 else mesh.vertices * 0
    if not np.isfinite(extent) or not np.isfinite(scaled).all():
        raise DataError(f"{path}: coordinates of up to {np.abs(mesh.vertices).max():.3g} are too large. Scale it.")
    a, b, c = (scaled[mesh.triangles[:, i]] for i in range(3))
    kept = mesh.triangles[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0]
    if not len(kept):
        raise DataError(f"{path}: no face has an area. Expected a surface.")
    if len(kept) > MOST_TRIANGLES:
        raise DataError(f"{path}: has {len(kept)} triangles, at most {MOST_TRIANGLES} are taken. Simplify the mesh.")
    used, renumbered = np.unique(kept, return_inverse=True)
    return Mesh(scaled[used], renumbered.reshape(kept.shape).astype(np.int64))


def _placed(mesh: Mesh, path: Path, up: str) -> Mesh:
    # Cyclic permutations of the axes are rotations: the object is not mirrored.
    turn = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}[up]
    vertices = mesh.vertices[:, turn]
    low, high = vertices.min(0), vertices.max(0)
    base = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    vertices = (vertices - base) * (SIZE / (high - low).max())
    if vertices[:, 2].max() < 0.05 * SIZE:
        raise DataError(f"{path}: is flat along its up axis '{up}'. Choose another --up.")
    return Mesh(vertices, mesh.triangles)


def refine(mesh: Mesh, longest: float, path: Path = Path("mesh")) -> Mesh:
    """Halves edges until none is longer than ``longest``; neighbours stay joined."""
    vertices, triangles = mesh.vertices, mesh.triangles
    while True:
        corners = np.stack([triangles, np.roll(triangles, -1, 1)], -1)  # (T, 3, 2): edge i joins corners i and i + 1
        edges, which = np.unique(np.sort(corners.reshape(-1, 2), 1), axis=0, return_inverse=True)
        split = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) > longest
        if not split.any():
            return Mesh(vertices, triangles)
        middles = np.where(split, len(vertices) + np.cumsum(split) - 1, -1)[which.reshape(-1)].reshape(-1, 3)
        vertices = np.concatenate([vertices, vertices[edges[split]].mean(1)])
        triangles = _split(triangles, middles)
        if len(triangles) > MOST_TRIANGLES:
            raise DataError(
                f"{path}: its long edges need more than {MOST_TRIANGLES} triangles to bend. Remesh it evenly."
            )


def _split(triangles: Indices, middles: Indices) -> Indices:
    """Triangles (T, 3) divided at the middles (T, 3) of their edges; -1 where an edge stays whole."""
    count = (middles >= 0).sum(1)
    made = [triangles[count == 0]]
    for shift in range(3):
        t, m = np.roll(triangles, -shift, 1), np.roll(middles, -shift, 1)
        one = (count == 1) & (m[:, 0] >= 0)
        made += [np.column_stack((m[one, 0], t[one, 2], t[one, 0])), np.column_stack((m[one, 0], t[one, 1], t[one, 2]))]
        two = (count == 2) & (m[:, 2] < 0)
        made += [
            np.column_stack((m[two, 0], t[two, 1], m[two, 1])),
            np.column_stack((t[two, 0], m[two, 0], m[two, 1])),
            np.column_stack((t[two, 0], m[two, 1], t[two, 2])),
        ]
    t, m = triangles[count == 3], middles[count == 3]
    made += [np.column_stack((t[:, i], m[:, i], m[:, i - 1])) for i in range(3)] + [m]
    return np.concatenate(made)


def paint(vertices: Array, rng: np.random.Generator) -> Array:
    """Linear RGB (V, 3): waves of three lengths over a warm ground, and dark spots, so that motion shows everywhere."""
    colours = np.full(vertices.shape, (0.80, 0.70, 0.58))
    for waves_per_unit, contrast in ((0.3, 0.05), (0.7, 0.06), (1.4, 0.06)):
        for _ in range(4):
            direction = rng.normal(size=3)
            phase = 2 * math.pi * waves_per_unit * (vertices @ (direction / np.linalg.norm(direction)))
            wave = np.sin(phase + rng.uniform(0, 2 * math.pi))
            colours += contrast * wave[:, None] * rng.normal(1.0, 0.7, 3)
    for center in vertices[rng.integers(len(vertices), size=40)]:
        width, shade = rng.uniform(0.04, 0.09), rng.uniform(0.7, 1.8)
        cover = np.exp(-((vertices - center) ** 2).sum(1) / (2 * width**2))[:, None]
        colours = colours * (1 - cover) + cover * shade * np.array([0.30, 0.18, 0.10])
    return np.clip(colours, 0.03, 0.95)


def farthest_points(vertices: Array, count: int) -> Indices:
    """Sorted indices of ``count`` vertices (all where there are fewer) that lie far from each other, the top first."""
    if count >= len(vertices):
        return np.arange(len(vertices))
    return np.sort(farthest(vertices, count, int(vertices[:, 2].argmax())))
