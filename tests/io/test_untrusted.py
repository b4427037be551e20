"""Files that claim more than they hold, or numbers that no machine number holds."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from gausim.io.npz import read_npz
from gausim.io.pixels import decode, read_header
from gausim.io.plain_json import parse_json


@pytest.mark.parametrize(
    ("text", "what"),
    [("[NaN]", r"invalid character \(byte 1\)"), ('{"a": [{"b": -Infinity}]}', r"\(byte 14\)"),
     ('{"a": 1e999}', "out of range"), ("9" * 400, "more than 64 bits"), (str(1 << 64), "more than 64 bits"),
     ('{"a": 1e999, "a": 2}', "out of range"), ("[" * 100_000, "nested"), ("{", "truncated")],
)  # fmt: skip
def test_json_beyond_its_standard_is_refused(text: str, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        parse_json(text)


def test_plain_json_is_read() -> None:
    assert parse_json(b'{"a": [1, -2.5e3, null, true, "x"]}') == {"a": [1, -2500.0, None, True, "x"]}


def archive(path: Path, content: bytes, name: str = "points.npy") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(name, content)
    return path


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def test_an_array_that_claims_more_than_is_there_takes_no_memory(tmp_path: Path) -> None:
    content = npy(np.zeros((3, 3), np.float32)).replace(b"(3, 3)", b"(999999999, 999)")
    with pytest.raises(ValueError, match=r"'points' has \d+ bytes, its shape \(999999999, 999\) needs"):
        read_npz(archive(tmp_path / "x.npz", content))


def test_arrays_of_another_byte_order_are_turned(tmp_path: Path) -> None:
    found = read_npz(archive(tmp_path / "x.npz", npy(np.arange(5, dtype=">f4"))))["points"]
    assert found.dtype.isnative and found.tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY\x09\x00", b"\x93NUMPY\x01\x00\x05\x00{((((", b"no array"])
def test_members_that_are_no_arrays(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(ValueError, match="points"):
        read_npz(archive(tmp_path / "x.npz", content))


def test_an_image_that_claims_gigabytes_is_none(tmp_path: Path) -> None:
    path = tmp_path / "x.bmp"
    cv2.imwrite(str(path), np.zeros((4, 6, 3), np.uint8))
    header, pixels = read_header(path), decode(path)
    assert header is not None and (header.width, header.height, header.mode) == (6, 4, "RGB")
    assert pixels is not None and pixels.shape == (4, 6, 3)
    data = bytearray(path.read_bytes())
    data[18:26] = (60_000).to_bytes(4, "little") * 2
    path.write_bytes(bytes(data))
    assert read_header(path) is None and decode(path) is None
