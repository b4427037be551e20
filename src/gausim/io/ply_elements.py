"""Elements of PLY files, in text or binary of either byte order, read without trusting what a header declares."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gausim.core.errors import DataError

# Type names of the PLY specification, and synonyms of later writers.
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
# Far above any header of a scene or a mesh; a binary file without end_header must not be read whole as text.
_HEADER_LIMIT = 1 << 16


@dataclass
class Element:
    """One kind of thing in a PLY file."""

    name: str  # e.g. ``vertex``
    count: int  # how many there are
    fields: dict[str, tuple[str, str]]  # numpy's types as stored: of a property, and of a list's length, else empty

    @property
    def lists(self) -> list[str]:
        """The fields that are lists."""
        return [name for name, (_, counter) in self.fields.items() if counter]

    @property
    def row(self) -> np.dtype:
        """Memory layout of one without lists."""
        return np.dtype([(name, kind) for name, (kind, _) in self.fields.items()])


def read_elements(path: Path) -> Iterator[tuple[Element, Any]]:
    """The elements of a file in their order, each with its columns by name; numbers of a text are float64.

    The columns are fields of one structured array, or arrays of their own of an element with lists; they are lists
    themselves where these lists differ in length.

    Raises:
        DataError: the file is missing, no PLY file, cut off, or longer than its header says.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file. Expected a scene, points or a mesh in PLY format.")
    data = path.read_bytes()
    text, elements, start = _header(path, data)
    body, at = memoryview(_numbers(path, data[start:]) if text else data[start:]), 0
    for element in elements:
        columns, at = _take(path, element, body, at)
        # Some writers end with a line break; room for one thing more means that the number of things is wrong.
        least = 1 if text else element.row.itemsize
        if element is elements[-1] and not element.lists and len(body) - at >= least:
            raise DataError(
                f"{path}: has {len(body) - at} bytes after {element.count} of '{element.name}'. It is not what its "
                "header says; export it again."
            )
        yield element, columns


def positions(path: Path, element: Element, columns: Any) -> np.ndarray:
    """(N, 3) float64 of an element's fields x, y and z.

    Raises:
        DataError: one is missing or a list.
    """
    numbers = sorted(set(element.fields) - set(element.lists))
    if not {"x", "y", "z"} <= set(numbers):
        raise DataError(f"{path}: '{element.name}' has fields {numbers}, expected x, y and z.")
    return np.stack([np.asarray(columns[axis], np.float64) for axis in "xyz"], 1)


def _header(path: Path, data: bytes) -> tuple[bool, list[Element], int]:
    """Whether it is a text, elements, and where their data start [bytes]."""
    if not data.startswith((b"ply\n", b"ply\r\n")):
        raise DataError(f"{path}: expected a PLY file (first line 'ply'), got {data[:8]!r}. Check the file format.")
    end = data.find(b"end_header", 0, _HEADER_LIMIT)
    stop = data.find(b"\n", end, _HEADER_LIMIT)
    if end < 0 or stop < 0:
        raise DataError(f"{path}: line 'end_header' is missing. The file is truncated or not a PLY; export it again.")
    encoding, elements = "", list[Element]()
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        try:
            match line.split():
                case ["format", encoding, _] if encoding in _BYTE_ORDER:
                    pass
                case ["element", name, count] if count.isascii() and count.isdigit():
                    elements.append(Element(name, int(count), {}))
                case ["property", *kinds, name] if elements and name not in elements[-1].fields:
                    elements[-1].fields[name] = _field(kinds, encoding)
                case [first, *_] if first not in ("comment", "obj_info"):
                    raise ValueError("an unknown or repeated line")
        except (IndexError, KeyError, ValueError) as error:
            raise DataError(f"{path}: header line '{line[:60]}' is not understood ({error}). Export again.") from None
    if not encoding:
        raise DataError(f"{path}: header line 'format' is missing; expected one of {', '.join(_BYTE_ORDER)} 1.0.")
    for element in elements:
        # Every thing takes at least a byte, so that a file's size bounds what it may declare.
        if element.count > len(data) or (element.count and not element.fields):
            raise _truncated(path, element, len(data))
    return encoding == "ascii", elements, stop + 1


def _field(kinds: list[str], encoding: str) -> tuple[str, str]:
    """Types of a property as stored; all numbers of a text are read as float64, whatever the header calls them."""
    counter = _TYPES[kinds[1]] if kinds[0] == "list" else ""
    if len(kinds) != (3 if counter else 1) or counter.startswith("f"):
        raise ValueError("expected a type, or 'list' with the types of length and values")
    order = _BYTE_ORDER.get(encoding, "")
    stored = [order + (code if encoding != "ascii" else "f8") for code in (_TYPES[kinds[-1]], counter)]
    return stored[0], stored[1] if counter else ""


def _numbers(path: Path, text: bytes) -> bytes:
    """The words of a text as float64."""
    try:
        return np.array(text.split(), np.float64).tobytes()
    except ValueError as error:
        raise DataError(f"{path}: expected numbers after the header ({error!s:.80}). Export it again.") from None


def _take(path: Path, element: Element, body: memoryview, at: int) -> tuple[Any, int]:
    """The columns of an element whose data begin at a byte, and where they end."""
    if not element.count:
        return {name: np.zeros(0) for name in element.fields}, at
    if not element.lists:
        rows = _values(path, element, body, at, element.row, element.count)
        return rows, at + rows.nbytes
    found: dict[str, list[Any]] = {name: [] for name in element.fields}
    for _ in range(element.count):
        for name, (kind, counter) in element.fields.items():
            length = 1
            if counter:
                stated = float(_values(path, element, body, at, np.dtype(counter), 1)[0])
                if not (stated.is_integer() and 0 <= stated <= len(body)):
                    raise DataError(
                        f"{path}: list '{name}' of '{element.name}' has length {stated:g}. Export it again."
                    )
                length, at = int(stated), at + np.dtype(counter).itemsize
            values = _values(path, element, body, at, np.dtype(kind), length)
            found[name].append(values if counter else values[0])
            at += values.nbytes
    return {name: np.array(v) if len(set(map(np.size, v))) == 1 else v for name, v in found.items()}, at


def _values(path: Path, element: Element, body: memoryview, at: int, dtype: np.dtype, count: int) -> np.ndarray:
    """Numbers or rows of an element that begin at a byte, all of which are there."""
    if at + count * dtype.itemsize > len(body):
        raise _truncated(path, element, len(body) - at)
    return np.frombuffer(body, dtype, count, at)


def _truncated(path: Path, element: Element, left: int) -> DataError:
    return DataError(
        f"{path}: declares {element.count} of '{element.name}', for which {left} bytes are too few. It is truncated; "
        "copy or export it again."
    )
