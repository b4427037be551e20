"""A reader of pickles that calls nothing: arrays, lists, tuples, dicts, numbers, texts and bytes, and nothing else.

A pickle is a program. This reader does not hand it to Python's own: it goes through the opcodes and keeps those that
make plain data. The few names that numpy writes for its arrays are recognised by their text; none is ever looked up.
"""

from __future__ import annotations

import pickletools
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gausim.core.errors import DataError

# Element types of arrays: truth values, whole numbers, floating-point numbers.
_ELEMENT = re.compile(r"b1|[iu][1248]|f[248]")
_KEYS = (str, bytes, int, float)
# Arrays may take this many times the file's bytes: memory is copied where the file names the same bytes twice.
_MOST_COPIES = 4
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_VALUES = ("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "BINSTRING",
           "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8", "UNICODE", "BINUNICODE",
           "SHORT_BINUNICODE", "BINUNICODE8")  # fmt: skip


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
            return _Machine(data).run()
    except (ValueError, IndexError, TypeError, KeyError, OverflowError, MemoryError) as error:
        raise DataError(
            f"{path}: {str(error) or type(error).__name__}. Only arrays, lists, tuples, dicts, numbers and texts are "
            "read from a pickle, and nothing in it is executed. Take the file that the set's authors publish."
        ) from error


class _Name(str):
    """A name that a pickle asks for; only ever compared with the known ones."""


class _Element:
    """Type of an array's elements, before and after its byte order is known."""

    def __init__(self, code: str) -> None:
        self.code, self.order = code, "="

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(self.order.replace("|", "=") + self.code)


class _Machine:
    """The stack of one pickle."""

    def __init__(self, data: bytes) -> None:
        self._data, self._left = data, _MOST_COPIES * len(data)
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        self._blank: dict[int, np.ndarray] = {}  # arrays without content yet, by identity

    def run(self) -> Any:
        for opcode, argument, place in pickletools.genops(self._data):
            name = opcode.name
            if name == "STOP":
                if len(self._stack) != 1 or place is None or place + 1 < len(self._data):
                    raise ValueError("holds more or less than one value")
                result = self._stack[0]
                self._check_plain(result)
                return result
            if name in _CONSTANTS:
                self._stack.append(_CONSTANTS[name])
            elif name in _VALUES:
                self._stack.append(bytes(argument) if isinstance(argument, bytearray) else argument)
            elif name in _ACTIONS:
                _ACTIONS[name](self, argument)
            elif name not in ("PROTO", "FRAME"):
                raise ValueError(f"opcode {name} at byte {place} makes no plain data")
        raise ValueError("it ends too early")

    def pop_marked(self) -> list[Any]:
        """What stands above the last mark."""
        at = self._marks.pop()
        items, self._stack[at:] = self._stack[at:], []
        return items

    def mark(self, _: Any) -> None:
        self._marks.append(len(self._stack))

    def gather(self, kind: Callable[[list[Any]], Any]) -> None:
        self._stack.append(kind(self.pop_marked()))

    def gather_last(self, count: int) -> None:
        if len(self._stack) < count:
            raise ValueError("a tuple has too few items")
        items, self._stack[len(self._stack) - count :] = self._stack[len(self._stack) - count :], []
        self._stack.append(tuple(items))

    def extend(self, items: list[Any]) -> None:
        if type(self._stack[-1]) is not list:
            raise ValueError("items are appended to what is no list")
        self._stack[-1].extend(items)

    def update(self, items: list[Any]) -> None:
        if type(self._stack[-1]) is not dict:
            raise ValueError("entries are set in what is no dict")
        self._stack[-1].update(_pairs(items))

    def put(self, index: int | None) -> None:
        self._memo[len(self._memo) if index is None else index] = self._stack[-1]

    def get(self, index: int) -> None:
        self._stack.append(self._memo[index])

    def name(self, text: str) -> None:
        name = _Name(text.replace(" ", ".").replace("numpy.core.", "numpy._core."))
        if name not in _CALLS and name != "numpy.ndarray":
            raise ValueError(f"asks for '{name[:80]}'")
        self._stack.append(name)

    def name_of_two(self) -> None:
        last, first = self._stack.pop(), self._stack.pop()
        if type(first) is not str or type(last) is not str:
            raise ValueError("a name is no text")
        self.name(f"{first} {last}")

    def call(self) -> None:
        arguments, name = self._stack.pop(), self._stack.pop()
        if type(name) is not _Name or name not in _CALLS or type(arguments) is not tuple:
            raise ValueError(f"calls {str(name)[:80]!r}")
        self._stack.append(_CALLS[name](self, *arguments))

    def build(self) -> None:
        state, target = self._stack.pop(), self._stack[-1]
        if isinstance(target, _Element) and type(state) is tuple and len(state) >= 5:
            if state[1] not in ("<", ">", "|", "=") or state[2:5] != (None, None, None):
                raise ValueError("an array has elements of several parts")
            target.order = state[1]
        elif id(target) in self._blank and type(state) is tuple and len(state) == 5:
            _, shape, element, fortran, raw = state
            raw = raw.encode("latin1") if type(raw) is str else raw
            dtype = self._checked(raw, element, shape)
            whole: Any = (1, shape, dtype, bool(fortran), raw)
            self._blank.pop(id(target)).__setstate__(whole)
        else:
            raise ValueError(f"sets the state of a {type(target).__name__}")

    def blank(self, kind: Any, shape: Any, code: Any) -> np.ndarray:
        if kind != "numpy.ndarray" or shape != (0,) or code not in (b"b", "b"):
            raise ValueError("an array is made in an unknown way")
        array = np.empty(0, np.int8)
        self._blank[id(array)] = array
        return array

    def element(self, code: Any, *_: Any) -> _Element:
        if type(code) is not str or not _ELEMENT.fullmatch(code):
            raise ValueError(f"an array holds elements of type {str(code)[:40]!r}, expected numbers")
        return _Element(code)

    def from_buffer(self, raw: Any, element: Any, shape: Any, order: Any) -> np.ndarray:
        dtype = self._checked(raw, element, shape)
        if order not in ("C", "F"):
            raise ValueError("an array's order is unknown")
        return np.frombuffer(raw, dtype).reshape(shape, order="C" if order == "C" else "F")

    def scalar(self, element: Any, raw: Any) -> Any:
        return np.frombuffer(raw, self._checked(raw, element, ()))[0].item()

    def encoded(self, text: Any, encoding: Any) -> bytes:
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

    def _check_plain(self, result: Any) -> None:
        """Refuses parts of arrays that never became one."""
        known, todo = set[int](), [result]
        while todo:
            value = todo.pop()
            if isinstance(value, _Name | _Element) or id(value) in self._blank:
                raise ValueError("an array is not complete")
            if isinstance(value, list | tuple | dict) and id(value) not in known:
                known.add(id(value))
                todo += value.values() if isinstance(value, dict) else value


def _pairs(items: list[Any]) -> dict[Any, Any]:
    keys = items[::2]
    if len(items) % 2 or not all(isinstance(key, _KEYS) for key in keys):
        raise ValueError("a dict has keys that are no texts or numbers")
    return dict(zip(keys, items[1::2], strict=True))


_ACTIONS: dict[str, Callable[[_Machine, Any], None]] = {
    "MARK": _Machine.mark,
    "EMPTY_LIST": lambda machine, _: machine._stack.append([]),
    "EMPTY_TUPLE": lambda machine, _: machine._stack.append(()),
    "EMPTY_DICT": lambda machine, _: machine._stack.append({}),
    "LIST": lambda machine, _: machine.gather(list),
    "TUPLE": lambda machine, _: machine.gather(tuple),
    "DICT": lambda machine, _: machine.gather(_pairs),
    "TUPLE1": lambda machine, _: machine.gather_last(1),
    "TUPLE2": lambda machine, _: machine.gather_last(2),
    "TUPLE3": lambda machine, _: machine.gather_last(3),
    "APPEND": lambda machine, _: machine.extend([machine._stack.pop()]),
    "APPENDS": lambda machine, _: machine.extend(machine.pop_marked()),
    "SETITEM": lambda machine, _: machine.update([machine._stack.pop(), machine._stack.pop()][::-1]),
    "SETITEMS": lambda machine, _: machine.update(machine.pop_marked()),
    "PUT": _Machine.put, "BINPUT": _Machine.put, "LONG_BINPUT": _Machine.put, "MEMOIZE": _Machine.put,
    "GET": _Machine.get, "BINGET": _Machine.get, "LONG_BINGET": _Machine.get,
    "GLOBAL": _Machine.name,
    "STACK_GLOBAL": lambda machine, _: machine.name_of_two(),
    "REDUCE": lambda machine, _: machine.call(),
    "BUILD": lambda machine, _: machine.build(),
}  # fmt: skip
# What numpy's pickles call, by its name, and what is done in its place.
_CALLS: dict[str, Callable[..., Any]] = {
    "numpy._core.multiarray._reconstruct": _Machine.blank,
    "numpy.dtype": _Machine.element,
    "numpy._core.multiarray.scalar": _Machine.scalar,
    "numpy._core.numeric._frombuffer": _Machine.from_buffer,
    "_codecs.encode": _Machine.encoded,
    "__builtin__.bytes": lambda machine: b"",  # how old protocols write bytes without content
}
