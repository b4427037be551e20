"""Archives of numpy arrays, read without pickles and without trusting the declared sizes."""

from __future__ import annotations

import math
import tokenize
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from gausim.core.errors import DataError

_SUFFIX, _MAGIC = ".npy", b"\x93NUMPY"
# Highest compression ratio of deflate; a member that claims more is damaged.
_MOST_PACKED = 1100


def read_npz(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an npz file, optionally only existing ones of these names, in native byte order.

    Raises:
        ValueError: the file is missing, damaged, not npz, or has other content than arrays; without the file name.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) == _MAGIC:
                raise ValueError("a single array, expected an archive of arrays")
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(_SUFFIX): info for info in archive.infolist()}
            chosen = [name for name in members if names is None or name in names]
            return {name: _array(archive, members[name], name) for name in chosen}
    except (OSError, EOFError, KeyError, NotImplementedError, RuntimeError, zlib.error, zipfile.BadZipFile) as error:
        raise ValueError(str(error) or type(error).__name__) from error


def read_array(path: Path, field: str) -> np.ndarray:
    """One array of an npz file, of numbers that are finite in float32.

    Raises:
        DataError: the file is missing or damaged, has no such array, or one of anything else; names file and field.
    """
    try:
        arrays = read_npz(path, [field])
    except ValueError as error:
        raise DataError(f"{path}: cannot be read as npz ({error}).") from error
    if field not in arrays:
        raise DataError(f"{path}: array '{field}' is missing.")
    values = arrays[field]
    if values.dtype.kind not in "biuf":
        raise DataError(f"{path}: array '{field}' holds {values.dtype}, expected numbers.")
    with np.errstate(over="ignore"):
        if values.dtype.kind == "f" and not np.isfinite(values.astype(np.float32, copy=False)).all():
            raise DataError(f"{path}: array '{field}' holds values that are no finite numbers in float32.")
    return values


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str) -> np.ndarray:
    """One member, after a check of its header against its size."""
    if info.file_size > _MOST_PACKED * (info.compress_size + 1):
        raise ValueError(f"member '{name}' claims {info.file_size} bytes, packed into {info.compress_size}")
    with archive.open(info) as member:
        shape, dtype = _header(member, name)
        if dtype.hasobject or dtype.kind not in "biufcSU":
            raise ValueError(f"member '{name}' holds {dtype}, expected numbers, truth values or texts")
        expected = member.tell() + math.prod(shape) * dtype.itemsize
        if min(shape, default=0) < 0 or expected != info.file_size:
            raise ValueError(f"member '{name}' has {info.file_size} bytes, its shape {shape} needs {expected}")
    with archive.open(info) as member:
        array = np.lib.format.read_array(member, allow_pickle=False)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _header(member: Any, name: str) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type declared by a member."""
    try:
        version = np.lib.format.read_magic(member)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, _, dtype = read(member)
    except (ValueError, KeyError, TypeError, SyntaxError, tokenize.TokenError, MemoryError, RecursionError) as error:
        raise ValueError(f"member '{name}' is no array ({error})") from error
    return shape, dtype
