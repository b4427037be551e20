"""Reads surfaces from OBJ and PLY files (text and binary): triangles and polygons, nothing else of what they hold."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData

from gausim.core import DataError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

HEADER_LIMIT = 1 << 16
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
    data = path.read_bytes()
    for name, count in re.findall(rb"^element\s+(\S+)\s+(\S+)", data[:HEADER_LIMIT], re.MULTILINE):
        # Every element takes at least a byte, so that a file's size bounds what it may declare.
        if not count.isdigit() or len(count) > 18 or int(count) > len(data):
            told = f"declares {count.decode('latin-1'):.40} of '{name.decode('latin-1'):.40}'"
            raise DataError(f"{path}: {told}, but has {len(data)} bytes. Export it again.")
    try:
        found = _parsed_ply(path, data)
        if "face" not in found:
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        vertices = np.stack([np.asarray(found["vertex"][axis], np.float64) for axis in "xyz"], 1)
        lists = {each.name: each for each in found["face"].properties if each.name in FACE_FIELDS}
        if not lists:
            raise ValueError(f"its faces have no list {' or '.join(FACE_FIELDS)}")
        name, kind = next((name, each.val_dtype) for name, each in lists.items())
        if np.dtype(kind).kind not in "iu":
            raise ValueError("indices of vertices are whole numbers")
        corners = found["face"][name]
        if corners.ndim == 2:
            return vertices, corners.astype(np.int64)
        return vertices, np.array([t for face in corners for t in _fan(face.tolist())], np.int64).reshape(-1, 3)
    except Exception as error:  # plyfile lets those of numpy through
        raise DataError(f"{path}: cannot be read as a PLY file ({error}). Copy or export it again.") from error


def _parsed_ply(path: Path, data: bytes) -> PlyData:
    try:  # in one piece, where all faces are triangles
        return PlyData.read(path, known_list_len={"face": dict.fromkeys(FACE_FIELDS, 3)})
    except Exception:
        return PlyData.read(io.BytesIO(data))
