"""Pickles of plain data are read to the bit; of anything else nothing is executed, and the message names it."""

from __future__ import annotations

import collections
import decimal
import os
import pickle
import random
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.plain import Call

from data_prep.public.pickles import read_pickle
from gausim.core import DataError

ARRAY = np.random.default_rng(0).standard_normal((4, 3, 2))
PLAIN = {
    "array": ARRAY, "fortran": np.asfortranarray(ARRAY[:, :, 0]), "part": ARRAY[::2, ::2], "turned": ARRAY.T,
    "single": ARRAY.astype(np.float32), "whole": np.arange(5), "truth": ARRAY > 0.5, "empty": np.zeros((0, 3)),
    "order": ARRAY.astype(">f4"), "nan": np.array([np.nan, np.inf]), "scalar": np.float64(2.5), "twice": [ARRAY, ARRAY],
    "list": [1, -(2**70), 2.5, "ä", b"\x00\xff", True, None, [], {}, ()], "tuple": (1, (2, 3), (4, 5, 6, 7)),
    0: {1: {"object": ARRAY > 0}},
}  # fmt: skip


def check_same(found: Any, expected: Any) -> None:
    if isinstance(expected, np.ndarray):
        assert type(found) is np.ndarray and found.shape == expected.shape
        np.testing.assert_array_equal(found, expected)
    elif isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            check_same(found[key], value)
    elif isinstance(expected, list | tuple):
        assert type(found) is type(expected) and len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            check_same(one, other)
    else:
        assert found == expected


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_are_read(protocol: int, tmp_path: Path) -> None:
    path = tmp_path / "plain.pkl"
    path.write_bytes(pickle.dumps(PLAIN, protocol=protocol))
    check_same(read_pickle(path), PLAIN)


def test_names_of_older_numpy_are_known(tmp_path: Path) -> None:
    path = tmp_path / "old.pkl"
    new = pickle.dumps([ARRAY, ARRAY.T], protocol=2)
    path.write_bytes(new.replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    check_same(read_pickle(path), [ARRAY, ARRAY.T])


HOSTILE = {
    "posix.system": lambda command: Call(os.system, command),
    "builtins.eval": lambda command: {"a": [Call(eval, f"__import__('os').system({command!r})")]},
    "elements of type 'O8'": lambda command: np.array([Call(os.system, command)], dtype=object),
    "elements of type 'V": lambda command: np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f4")]),
    "elements of type 'U": lambda command: np.array(["text"]),
    "elements of type 'M8'": lambda command: np.datetime64("2020-01-01"),
    "nested": lambda command: Call(Call, Call(os.system, command)),
    "builtins.getattr": lambda command: Call(getattr, Call(np.dtype, "f8"), "type"),
    "numpy.load": lambda command: Call(np.load, command, None, True),
    "collections.OrderedDict": lambda command: collections.OrderedDict(a=1),
    "decimal.Decimal": lambda command: decimal.Decimal(1),
    "builtins.complex": lambda command: 1j,
    "EMPTY_SET": lambda command: {1, 2},
}


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize("told", HOSTILE)
def test_nothing_else_is_read_or_executed(told: str, protocol: int, tmp_path: Path) -> None:
    path, canary = tmp_path / "hostile.pkl", tmp_path / "canary"
    path.write_bytes(pickle.dumps(HOSTILE[told](f"touch '{canary}'"), protocol=protocol))
    with pytest.raises(DataError) as caught:
        read_pickle(path)
    assert not canary.exists() and str(path) in str(caught.value)
    if told != "nested" and protocol == 4:
        assert told in str(caught.value)


def dtype(code: bytes = b"f8") -> bytes:
    return b"cnumpy\ndtype\n(X" + struct.pack("<I", len(code)) + code + b"K\x00K\x01tR"


# A hand-written array: what is called with what, and a state of shape, type and content.
RAW = (
    b"cnumpy._core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85C\x01btR(K\x01%s%s\x89C\x08" + bytes(8) + b"tb."
)
CRAFTED = {
    "a shape that its bytes do not fill": RAW % (b"K\x63\x85", dtype()),
    "a shape below zero": RAW % (b"J\xff\xff\xff\xff\x85", dtype()),
    "a shape of texts": RAW % (b"X\x01\x00\x00\x001\x85", dtype()),
    "a huge shape": RAW % (b"\x8a\x08" + b"\xff" * 7 + b"\x7f\x85", dtype()),
    "no type": RAW % (b"K\x01\x85", b"K\x08"),
    "an array without content": b"cnumpy._core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85C\x01btR.",
    "a name instead of data": b"cnumpy\nndarray\n.",
    "a type instead of data": dtype() + b".",
    "an attribute of a list": b"]}X\x01\x00\x00\x00aK\x01sb.",
    "a call of a text": b"X\x09\x00\x00\x00os.system(X\x01\x00\x00\x00atR.",
    "a name put together": b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x02id\x85R.",
    "a call of what was called": b"cnumpy\ndtype\n)RX\x01\x00\x00\x00a\x85R.",
    "an extension": b"\x80\x02\x82\x01.",
    "a persistent name": b"\x80\x02X\x01\x00\x00\x00aQ.",
    "an object": b"\x80\x02cos\nsystem\n)\x81.",
    "an old instance": b"(X\x02\x00\x00\x00lsios\nsystem\n.",
    "a list as a key": b"}]K\x01s.",
    "two values": b"K\x01K\x02.",
    "two pickles": b"].].",
    "no end": b"]",
    "nothing": b"",
    "a mark too few": b"e.",
    "a memo without content": b"h\x07.",
    "a text beyond the end": b"X\xff\xff\xff\x7fabc.",
    "an unknown opcode": b"\xffabc.",
}


@pytest.mark.parametrize("name", CRAFTED)
def test_crafted_programs_are_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "crafted.pkl"
    path.write_bytes(CRAFTED[name])
    with pytest.raises(DataError, match=r"crafted\.pkl: .*nothing in it is executed"):
        read_pickle(path)


def test_a_small_file_fills_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "bomb.pkl"
    array = RAW[:-1] % (b"\x4d\x00\x04\x85", dtype())
    content, state = bytes(8192), b"C\x08" + bytes(8)
    first = array.replace(state, b"B" + struct.pack("<I", len(content)) + content + b"q\x01")
    # The same 8 kB as 1000 arrays.
    path.write_bytes(b"](" + first + 1000 * array.replace(state, b"h\x01") + b"e.")
    with pytest.raises(DataError, match="larger than the file"):
        read_pickle(path)
    path.write_bytes(b"](" + first + array.replace(state, b"h\x01") + b"e.")
    assert [one.shape for one in read_pickle(path)] == [(1024,), (1024,)]


def test_damaged_pickles_are_refused_or_read(tmp_path: Path) -> None:
    """Whatever stands in a file: an error in words, or plain data."""
    path, good = tmp_path / "damaged.pkl", pickle.dumps(PLAIN)
    rng, refused = random.Random(0), 0
    for _ in range(400):
        data = bytearray(good)
        for _ in range(rng.choice((1, 1, 2, 8))):
            data[rng.randrange(len(data))] = rng.randrange(256)
        path.write_bytes(data[: rng.randrange(len(data))] if rng.random() < 0.2 else data)
        try:
            read_pickle(path)
        except DataError:
            refused += 1
    assert 100 < refused < 400
