"""Reads surfaces from OBJ and PLY files (text and binary): triangles and polygons, nothing else of what they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gausim.core import DataError
from gausim.io.ply_elements import Element, positions, read_elements

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

FACE_FIELDS = ("vertex_indices", "vertex_index")
# Larger than any index of a file that fits into memory, and small enough for every integer type used here.
LARGEST_INDEX = 1 << 40


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
    """Reads an OBJ or PLY file; polygons become fans of triangles (right for convex ones).

    Raises:
        DataError: the file is missing, of another format, cut off, has no faces, faces with indices that are not there,
            or coordinates that are no finite numbers.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file. Expected a mesh in OBJ or PLY format.")
    readers = {".obj": _read_obj, ".ply": _read_ply}
    if path.suffix.lower() not in readers:
        raise DataError(f"{path}: expected a file that ends in .obj or .ply. Convert the mesh first.")
    vertices, triangles = readers[path.suffix.lower()](path)
    bad = np.flatnonzero(~np.isfinite(vertices).all(1))
    if len(bad):
        raise DataError(f"{path}: vertex {bad[0]} has a coordinate that is no finite number. Export the mesh again.")
    if not len(triangles):
        raise DataError(f"{path}: has {len(vertices)} vertices and no faces. Expected a surface.")
    outside = np.flatnonzero(((triangles < 0) | (triangles >= len(vertices))).any(1))
    if len(outside):
        raise DataError(
            f"{path}: a face uses vertices {triangles[outside[0]].tolist()} (counted from 0), there are "
            f"{len(vertices)}. Export the mesh again."
        )
    return Mesh(vertices, triangles)


def _read_obj(path: Path) -> tuple[Array, Indices]:
    text = path.read_bytes().decode("latin-1").replace("\\\r\n", " ").replace("\\\n", " ")
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split()
        try:
            if words[:1] == ["v"]:
                x, y, z = (float(word) for word in words[1:4])
                vertices.append([x, y, z])
            elif words[:1] == ["f"]:
                triangles += _fan([_obj_index(word, len(vertices)) for word in words[1:]])
        except ValueError as error:
            raise DataError(f"{path}: line {number}: '{line[:60]}' is no vertex or face ({error}).") from None
    return np.array(vertices, np.float64).reshape(-1, 3), np.array(triangles, np.int64).reshape(-1, 3)


def _obj_index(word: str, known: int) -> int:
    """Index from 0 on of ``7``, ``7/1/3`` or ``-1`` (the last vertex so far)."""
    index = int(word.split("/", 1)[0])
    if index == 0 or abs(index) > LARGEST_INDEX:
        raise ValueError("vertices are counted from 1, or backwards from -1")
    return index - 1 if index > 0 else known + index


def _fan(corners: Sequence[int]) -> list[tuple[int, int, int]]:
    if len(corners) < 3:
        raise ValueError(f"a face needs at least 3 corners, this has {len(corners)}")
    return [(corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1)]


def _read_ply(path: Path) -> tuple[Array, Indices]:
    vertices, triangles = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    for element, columns in read_elements(path):
        if element.name == "vertex":
            vertices = positions(path, element, columns)
        elif element.name == "face":
            triangles = _faces(path, element, columns)
    return vertices, triangles


def _faces(path: Path, element: Element, columns: Mapping[str, Any]) -> Indices:
    chosen = next((name for name in FACE_FIELDS if name in element.lists), None)
    if chosen is None:
        raise DataError(f"{path}: faces have lists {element.lists}, expected '{FACE_FIELDS[0]}'.")
    column = columns[chosen]
    if isinstance(column, np.ndarray) and column.ndim == 2 and column.shape[1] == 3:
        return _whole(path, column)
    triangles: list[tuple[int, int, int]] = []
    for i, corners in enumerate(column):
        try:
            triangles += _fan(_whole(path, np.asarray(corners)).tolist())
        except ValueError as error:
            raise DataError(f"{path}: face {i}: {error}.") from None
    return np.array(triangles, np.int64).reshape(-1, 3)


def _whole(path: Path, indices: np.ndarray) -> Indices:
    if not ((np.abs(indices.astype(np.float64)) <= LARGEST_INDEX) & (indices == np.trunc(indices))).all():
        raise DataError(f"{path}: a face uses a vertex that is no whole number up to {LARGEST_INDEX}. Export it again.")
    return indices.astype(np.int64)
