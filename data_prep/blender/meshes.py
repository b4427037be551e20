"""Reads surfaces from OBJ and PLY files (text and binary): triangles and polygons, nothing else of what they hold.

Every fault of a file is an error that names file and place; nothing is read beyond what the file's size can hold.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gausim.core import DataError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_ORDER = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
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


@dataclass
class _Element:
    """One kind of thing in a PLY file: how many; of each field its name, its type, and the type of a list's length."""

    name: str
    count: int
    fields: list[tuple[str, str, str | None]]

    def dtype(self, lengths: Sequence[int]) -> np.dtype:
        """Memory layout of one of them whose lists have these lengths."""
        parts: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        remaining = iter(lengths)
        for i, (_, kind, counter) in enumerate(self.fields):
            if counter is not None:
                parts += [(f"n{i}", counter), (f"f{i}", kind, (next(remaining),))]
            else:
                parts.append((f"f{i}", kind))
        return np.dtype(parts)

    def lists(self) -> list[int]:
        """Positions of the fields that are lists."""
        return [i for i, field in enumerate(self.fields) if field[2] is not None]


def _read_ply(path: Path) -> tuple[Array, Indices]:
    data = path.read_bytes()
    encoding, elements, start = _header(path, data)
    body = _Body(path, memoryview(data)[start:] if encoding != "ascii" else memoryview(_numbers(path, data[start:])))
    vertices, triangles = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    for element in elements:
        columns = body.take(element)
        if element.name == "vertex":
            vertices = _positions(path, element, columns)
        elif element.name == "face":
            triangles = _faces(path, element, columns)
    return vertices, triangles


def _numbers(path: Path, text: bytes) -> bytes:
    """The words of a text as float64, whatever the header calls them."""
    try:
        return np.array(text.split(), np.float64).tobytes()
    except ValueError as error:
        raise DataError(f"{path}: expected numbers after the header ({error!s:.80}). Export it again.") from None


def _header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """Encoding, elements and where their data starts [bytes]."""
    end = re.search(rb"\nend_header[ \t]*\r?\n", data[:HEADER_LIMIT])
    if not data.startswith(b"ply") or end is None:
        raise DataError(f"{path}: expected a PLY file ('ply' first, 'end_header' within {HEADER_LIMIT} bytes).")
    encoding, elements = "", []
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        words = line.split()
        try:
            if words[:1] == ["format"]:
                encoding = words[1]
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                elements[-1].fields.append(_field(words[1:], encoding))
        except (IndexError, KeyError, ValueError) as error:
            raise DataError(f"{path}: the header's line '{line[:60]}' is not of a PLY file ({error}).") from None
    if encoding not in PLY_ORDER:
        raise DataError(f"{path}: field 'format' is '{encoding}', expected one of {', '.join(PLY_ORDER)}.")
    for element in elements:
        # Every thing takes at least a byte, so that a file's size bounds what it may declare.
        if not 0 <= element.count <= len(data) or (element.count and not element.fields):
            raise DataError(f"{path}: declares {element.count} of '{element.name}', but has {len(data)} bytes.")
    return encoding, elements, end.end()


def _field(words: Sequence[str], encoding: str) -> tuple[str, str, str | None]:
    kinds = [PLY_TYPES[word] for word in (words[1:3] if words[0] == "list" else words[:1])]
    stored = ["<f8" if encoding == "ascii" else PLY_ORDER[encoding] + kind for kind in kinds]
    if words[0] != "list":
        return words[1], stored[0], None
    if kinds[0].startswith("f") or (words[3] in FACE_FIELDS and kinds[1].startswith("f")):
        raise ValueError("lengths and indices are whole numbers")
    return words[3], stored[1], stored[0]


def _positions(path: Path, element: _Element, columns: list[Iterable[object]]) -> Array:
    names = [name for name, _, counter in element.fields if counter is None]
    if not {"x", "y", "z"} <= set(names):
        raise DataError(f"{path}: vertices have fields {names}, expected x, y and z.")
    order = [field[0] for field in element.fields]
    return np.stack([np.asarray(columns[order.index(axis)], np.float64) for axis in "xyz"], 1)


def _faces(path: Path, element: _Element, columns: list[Iterable[object]]) -> Indices:
    names = [name for name, _, counter in element.fields if counter is not None]
    chosen = [name for name in FACE_FIELDS if name in names]
    if not chosen:
        raise DataError(f"{path}: faces have lists {names}, expected '{FACE_FIELDS[0]}'.")
    column = columns[[field[0] for field in element.fields].index(chosen[0])]
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


class _Body:
    """Elements one after another in memory."""

    def __init__(self, path: Path, data: memoryview) -> None:
        self.path, self.data, self.at = path, data, 0

    def take(self, element: _Element) -> list[Iterable[object]]:
        """The fields of the next ``element.count`` things: arrays, or lists of arrays where lengths differ."""
        lists = element.lists()
        if not element.count:
            return [np.zeros(0) for _ in element.fields]
        layout = element.dtype(self._lengths(element))
        if layout.itemsize * element.count <= len(self.data) - self.at:
            rows = np.frombuffer(self.data, layout, element.count, self.at)
            if all((rows[f"n{i}"] == rows[f"f{i}"].shape[1]).all() for i in lists):
                self.at += layout.itemsize * element.count
                return [rows[f"f{i}"] for i in range(len(element.fields))]
        if not lists:
            raise DataError(f"{self.path}: is cut off: {element.count} of '{element.name}' do not fit. Copy it again.")
        found: list[list[object]] = [[] for _ in element.fields]
        for _ in range(element.count):
            row = np.frombuffer(self.data, layout := element.dtype(self._lengths(element)), 1, self.at)[0]
            self.at += layout.itemsize
            for i, values in enumerate(found):
                values.append(row[f"f{i}"])
        return list(found)

    def _lengths(self, element: _Element) -> list[int]:
        """Lengths of the lists of the thing that comes next; all of it is there."""
        at, lengths = self.at, []
        for _, kind, counter in element.fields:
            size = np.dtype(kind).itemsize
            if counter is not None:
                self._need(at + np.dtype(counter).itemsize, element)
                length = float(np.frombuffer(self.data, counter, 1, at)[0])
                if not (length.is_integer() and 0 <= length <= len(self.data)):
                    raise DataError(f"{self.path}: a list of '{element.name}' has length {length:g}.")
                lengths.append(int(length))
                at += np.dtype(counter).itemsize
                size *= lengths[-1]
            at += size
            self._need(at, element)
        return lengths

    def _need(self, end: int, element: _Element) -> None:
        if end > len(self.data):
            raise DataError(f"{self.path}: is cut off within '{element.name}'. Copy or export it again.")
