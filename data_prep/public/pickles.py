"""A reader of pickles that calls nothing of others: arrays, lists, tuples, dicts, numbers, texts and bytes, no more.

A pickle is a program. Python's own reader runs it here, but it finds none of the names that the program asks for: the
few that numpy writes for its arrays are recognised by their text, and functions of this file are called in their place.
"""

from __future__ import annotations

import io
import pickle
import re
import struct
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from gausim.core.errors import DataError

# Element types of arrays: truth values, whole numbers, floating-point numbers.
_ELEMENT = re.compile(r"b1|[iu][1248]|f[248]")
_KEYS = (str, bytes, int, float)
_PLAIN = (np.ndarray, list, tuple, dict, str, bytes, int, float, type(None))
# Arrays may take this many times the file's bytes: memory is copied where the file names the same bytes twice.
_MOST_COPIES = 4
# Opcodes that make no plain data; the others are of data, or ask for a name and call it.
_REFUSED = ("EXT1", "EXT2", "EXT4", "PERSID", "BINPERSID", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EMPTY_SET",
            "ADDITEMS", "FROZENSET", "NEXT_BUFFER", "READONLY_BUFFER")  # fmt: skip
_NDARRAY = object()


def read_pickle(path: Path) -> Any:
    """The plain data in a pickle: numpy arrays of numbers or truth values, lists, tuples, dicts, numbers, texts, bytes.

    Raises:
        DataError: the file is missing or damaged, or holds anything else; nothing in it was executed.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}). Expected a pickle of arrays.") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _Reader(data).plain()
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, EOFError, struct.error,
            pickle.UnpicklingError) as error:  # fmt: skip
        raise DataError(
            f"{path}: {str(error) or type(error).__name__}. Only arrays, lists, tuples, dicts, numbers and texts are "
            "read from a pickle, and nothing in it is executed. Take the file that the set's authors publish."
        ) from error


@dataclass
class _Element:
    """Type of an array's elements, before and after its byte order is known."""

    code: str
    order: str = "="

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(self.order.replace("|", "=") + self.code)


def _refuse(name: str, _: Any) -> None:
    raise ValueError(f"opcode {name} makes no plain data")


class _Reader(pickle._Unpickler):
    """Python's reader, the one in Python: damage cannot do more to it than raise an exception."""

    stack: list[Any]
    metastack: list[Any]

    def __init__(self, data: bytes) -> None:
        self._file, self._left = io.BytesIO(data), _MOST_COPIES * len(data)
        super().__init__(self._file, encoding="latin1")  # as Python 2 wrote the content of arrays
        self._blank: dict[int, np.ndarray] = {}  # arrays without content yet, by identity
        # What numpy's pickles call, by its name, and what is called in its place.
        self._known: dict[str, Any] = {
            "numpy.ndarray": _NDARRAY,
            "numpy.dtype": self._make_element,
            "numpy._core.multiarray._reconstruct": self._make_blank,
            "numpy._core.multiarray.scalar": self._make_scalar,
            "numpy._core.numeric._frombuffer": self._make_array,
            "_codecs.encode": self._encode,
            "__builtin__.bytes": lambda: b"",  # how old protocols write bytes without content
        }

    def plain(self) -> Any:
        """The data, once nothing else is among them."""
        result = self.load()
        if self.stack or self.metastack or self._file.read(1):
            raise ValueError("holds more than one value")
        known, todo = set[int](), [result]
        while todo:
            value = todo.pop()
            if id(value) in self._blank or type(value) not in (*_PLAIN, bool):
                raise ValueError(f"an array is not complete, or there is a {type(value).__name__}")
            if isinstance(value, list | tuple | dict) and id(value) not in known:
                known.add(id(value))
                todo += value.values() if isinstance(value, dict) else value
            if isinstance(value, dict) and not all(isinstance(key, _KEYS) for key in value):
                raise ValueError("a dict has keys that are no texts or numbers")
        return result

    def find_class(self, module: str, name: str) -> Any:
        asked = f"{module}.{name}".replace("numpy.core.", "numpy._core.")
        if asked not in self._known:
            raise ValueError(f"asks for '{asked[:80]}'")
        return self._known[asked]

    def load_build(self) -> None:
        """Sets the state of types of elements and of arrays, and of nothing else."""
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, _Element) and type(state) is tuple and len(state) >= 5:
            if state[1] not in ("<", ">", "|", "=") or state[2:5] != (None, None, None):
                raise ValueError("an array has elements of several parts")
            target.order = state[1]
        elif id(target) in self._blank and type(state) is tuple and len(state) == 5:
            _, shape, element, fortran, raw = state
            raw = raw.encode("latin1") if type(raw) is str else raw
            whole: Any = (1, shape, self._checked(raw, element, shape), bool(fortran), raw)
            self._blank.pop(id(target)).__setstate__(whole)
        else:
            raise ValueError(f"sets the state of a {type(target).__name__}")

    dispatch: ClassVar[dict[int, Callable[[Any], None]]] = {
        **pickle._Unpickler.dispatch,
        **{getattr(pickle, name)[0]: partial(_refuse, name) for name in _REFUSED},
        pickle.BUILD[0]: load_build,
    }

    def _make_blank(self, kind: Any, shape: Any, code: Any) -> np.ndarray:
        if kind is not _NDARRAY or shape != (0,) or code not in (b"b", "b"):
            raise ValueError("an array is made in an unknown way")
        array = np.empty(0, np.int8)
        self._blank[id(array)] = array
        return array

    def _make_element(self, code: Any, *_: Any) -> _Element:
        if type(code) is not str or not _ELEMENT.fullmatch(code):
            raise ValueError(f"an array holds elements of type {str(code)[:40]!r}, expected numbers")
        return _Element(code)

    def _make_array(self, raw: Any, element: Any, shape: Any, order: Any) -> np.ndarray:
        raw = bytes(raw) if type(raw) is bytearray else raw
        dtype = self._checked(raw, element, shape)
        if order not in ("C", "F"):
            raise ValueError("an array's order is unknown")
        return np.frombuffer(raw, dtype).reshape(shape, order="C" if order == "C" else "F")

    def _make_scalar(self, element: Any, raw: Any) -> Any:
        return np.frombuffer(raw, self._checked(raw, element, ()))[0].item()

    def _encode(self, text: Any, encoding: Any) -> bytes:
        if type(text) is not str or encoding != "latin1":
            raise ValueError("bytes are encoded in an unknown way")
        self._spend(len(text))
        return text.encode("latin1")

    def _checked(self, raw: Any, element: Any, shape: Any) -> np.dtype:
        """The type of an array's elements, if its bytes are as many as its shape needs."""
        if not isinstance(element, _Element) or type(raw) is not bytes or type(shape) is not tuple:
            raise ValueError("an array has no type, shape or content")
        if not all(type(length) is int and length >= 0 for length in shape) or len(shape) > 8:
            raise ValueError(f"an array has the shape {str(shape)[:80]}")
        needed = element.dtype.itemsize
        for length in shape:
            needed *= length
        if needed != len(raw) or (element.code == "b1" and raw.strip(b"\0\1")):
            raise ValueError(f"an array of shape {str(shape)[:80]} has {len(raw)} bytes, expected {str(needed)[:40]}")
        self._spend(needed)
        return element.dtype

    def _spend(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise ValueError("its arrays are larger than the file")
