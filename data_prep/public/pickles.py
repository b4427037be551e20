"""Pickles of numpy arrays: lists, tuples, dicts, numbers and texts may hold them; nothing else is made or called."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np

from gausim.core.errors import DataError

# What numpy's own pickles name; functions of this file take the place of what would be called.
_ARRAY = object()
_ELEMENTS = {f"{kind}{size}" for kind in "iuf" for size in (1, 2, 4, 8)} - {"f1"} | {"b1"}
_PLAIN = (list, tuple, dict, str, bytes, int, float, bool, type(None))
# Arrays may take this many times the file's bytes: memory is copied where the file names the same bytes twice.
_MOST_COPIES = 4


def read_pickle(path: Path) -> Any:
    """The numpy arrays of numbers or truth values in a pickle, in lists, tuples and dicts."""
    try:
        with path.open("rb") as file:
            data = _Unpickler(file, encoding="latin1").load()
            _check(data, _MOST_COPIES * path.stat().st_size)
            if file.read(1):
                raise ValueError("holds more than one value")
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}). Expected a pickle of arrays.") from error
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, EOFError, RecursionError,
            struct.error, pickle.UnpicklingError) as error:  # fmt: skip
        raise DataError(
            f"{path}: {str(error) or type(error).__name__}. Only arrays, lists, tuples, dicts, numbers and texts are "
            "read from a pickle, and nothing in it is executed. Take the file that the set's authors publish."
        ) from error
    return data


class _Unpickler(pickle.Unpickler):
    """Python's reader, which finds the names that numpy writes for arrays and no others."""

    def find_class(self, module: str, name: str) -> Any:
        known = {
            "numpy.ndarray": _ARRAY, "numpy.dtype": self._dtype, "_codecs.encode": self._encode,
            "numpy._core.multiarray._reconstruct": self._blank, "numpy._core.multiarray.scalar": self._scalar,
            "numpy._core.numeric._frombuffer": self._buffer, "__builtin__.bytes": self._no_bytes,
        }  # fmt: skip
        asked = f"{module}.{name}".replace("numpy.core.", "numpy._core.")
        if asked not in known:
            raise pickle.UnpicklingError(f"asks for '{asked[:80]}'")
        return known[asked]

    @staticmethod
    def _dtype(code: Any, *_: Any) -> np.dtype:
        if code not in _ELEMENTS:
            raise pickle.UnpicklingError(f"an array holds elements of type {str(code)[:40]!r}, expected numbers")
        # A new one, as its byte order is set next.
        return np.dtype(code, copy=True)

    @staticmethod
    def _blank(kind: Any, shape: Any, code: Any) -> np.ndarray:
        if kind is not _ARRAY or shape != (0,) or code not in (b"b", "b"):
            raise pickle.UnpicklingError("an array is made in an unknown way")
        return np.empty(0, np.int8)

    @staticmethod
    def _buffer(raw: Any, element: np.dtype, shape: Any, order: Any) -> np.ndarray:
        return np.frombuffer(bytes(raw), element).reshape(shape, order=order)

    @staticmethod
    def _no_bytes() -> bytes:
        return b""  # how old protocols write bytes without content

    @staticmethod
    def _scalar(element: np.dtype, raw: Any) -> Any:
        return np.frombuffer(raw, element)[0].item()

    @staticmethod
    def _encode(text: str, encoding: Any) -> bytes:
        if encoding != "latin1":
            raise pickle.UnpicklingError("bytes are encoded in an unknown way")
        return text.encode("latin1")


def _check(data: Any, most: int) -> None:
    """Raises where something is no plain data, or arrays take more than ``most`` bytes."""
    known, left = set[int](), [data]
    while left:
        value = left.pop()
        if id(value) in known:
            continue
        known.add(id(value))
        if type(value) is np.ndarray and value.dtype.kind in "biuf" and value.dtype.fields is None:
            most -= value.nbytes
        elif type(value) not in _PLAIN:
            raise ValueError(f"there is a {type(value).__name__}")
        left += [*value, *value.values()] if isinstance(value, dict) else value if type(value) in (list, tuple) else []
        if most < 0:
            raise ValueError("its arrays are larger than the file")
