"""The files of a COLMAP sparse model, binary or text, as rows; :mod:`gausim.io.colmap` says what they mean.

pycolmap does not replace this reader: of files that were cut off it reads some as if they were whole, and it allocates
whatever a count in a file claims. Here a count is compared with the bytes that are left before anything is allocated.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gausim.core.errors import DataError

# COLMAP's camera models: number in binary files, name in text files, count of parameters.
MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12),
}  # fmt: skip
PARAMETERS = dict(MODELS.values())
# What the binary format writes where a keypoint shows no point.
NO_POINT = (1 << 64) - 1
_CAMERA, _IMAGE, _POINT, _COUNT = (struct.Struct(f) for f in ("<IiQQ", "<I7dI", "<Q3d3BdQ", "<Q"))
_KEYPOINT, _TRACK = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")]), np.dtype("<u8")
_POINT_COLUMNS, _IMAGE_WORDS = 8, 10


class CameraRow(NamedTuple):
    """One camera: ``where`` is what messages call it, ``params`` are (p,) float64."""

    where: str
    number: int
    model: str
    width: int
    height: int
    params: np.ndarray


class ImageRow(NamedTuple):
    """One image: ``pose`` (7,) is its quaternion w x y z and translation; keypoints are those that show a point."""

    where: str
    number: int
    pose: np.ndarray
    camera: int
    name: str
    xy: np.ndarray
    point_ids: np.ndarray


@dataclass(frozen=True, eq=False)
class PointTable:
    """All of ``points3D``: ids (P,) int64, xyz (P, 3) and error (P,) float64, rgb (P, 3) uint8, tracks (P,) int64."""

    ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray
    tracks: np.ndarray


def read_cameras(path: Path) -> Iterator[CameraRow]:
    """The cameras of ``cameras.bin`` or ``cameras.txt``.

    Raises:
        DataError: naming the file, the camera and the field that is cut off, malformed or of an unknown model.
    """
    return _cameras_binary(path) if path.suffix == ".bin" else _cameras_text(path)


def read_images(path: Path) -> Iterator[ImageRow]:
    """The images of ``images.bin`` or ``images.txt``; raises like :func:`read_cameras`."""
    return _images_binary(path) if path.suffix == ".bin" else _images_text(path)


def read_points(path: Path) -> PointTable:
    """The points of ``points3D.bin`` or ``points3D.txt``; raises like :func:`read_cameras`."""
    rows = list(_points_binary(path) if path.suffix == ".bin" else _points_text(path))
    table = np.array([row for row, _ in rows]).reshape(-1, _POINT_COLUMNS)
    rgb = table[:, 4:7]
    # Comparisons with NaN are false, so it is refused too.
    if not ((rgb >= 0) & (rgb <= 255) & (rgb == np.floor(rgb))).all():
        raise DataError(f"{path}: field 'rgb' must hold whole numbers from 0 to 255. Export the model again.")
    tracks = np.array([track for _, track in rows], np.int64)
    return PointTable(_ids(path, table[:, 0]), table[:, 1:4], rgb.astype(np.uint8), table[:, 7], tracks)


class _Binary:
    """A binary file that is read forward, with an error where it ends too early."""

    def __init__(self, path: Path) -> None:
        self.path, self.at, self.data = path, 0, _contents(path)

    def need(self, count: int, where: str) -> int:
        """Goes on by ``count`` bytes; returns where they begin."""
        left = len(self.data) - self.at
        if count > left:
            raise DataError(
                f"{self.path}: {where}: expected {count} more bytes, the file has {left}. It is truncated or its "
                "counts are wrong; copy or export the model again."
            )
        self.at += count
        return self.at - count

    def take(self, layout: struct.Struct, where: str) -> tuple:
        return layout.unpack_from(self.data, self.need(layout.size, where))

    def table(self, dtype: np.dtype, count: int, where: str) -> np.ndarray:
        return np.frombuffer(self.data, dtype, count, self.need(count * dtype.itemsize, where))

    def name(self, where: str) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise DataError(f"{self.path}: {where}: field 'name' has no end. The file is truncated; export it again.")
        return _decoded(self.path, self.data[self.need(end + 1 - self.at, where) : end], f"{where}: field 'name'")

    def records(self, what: str) -> Iterator[str]:
        """What messages call each record of the file, which holds nothing after them."""
        (count,) = self.take(_COUNT, f"number of {what}")
        for i in range(count):
            yield f"{what}[{i}]"
        if self.at < len(self.data):
            raise DataError(
                f"{self.path}: {len(self.data) - self.at} bytes follow the last record. The counts are wrong; export "
                "the model again."
            )


def _cameras_binary(path: Path) -> Iterator[CameraRow]:
    file = _Binary(path)
    for where in file.records("cameras"):
        number, model, width, height = file.take(_CAMERA, where)
        name, count = MODELS.get(model) or _unknown_model(path, where, str(model))
        params = file.table(np.dtype("<f8"), count, f"{where}: field 'params' of {name}").copy()
        yield CameraRow(where, number, name, width, height, params)


def _cameras_text(path: Path) -> Iterator[CameraRow]:
    for where, words in _rows(path):
        if not words:
            continue
        model = words[1] if len(words) > 1 else ""
        expected = 4 + (PARAMETERS.get(model) or _unknown_model(path, where, model)[1])
        if len(words) != expected:
            raise DataError(f"{path}: {where}: expected {expected} words for {model}, got {len(words)}.")
        number, width, height = (_whole(path, where, words[i]) for i in (0, 2, 3))
        yield CameraRow(where, number, model, width, height, _numbers(path, where, words[4:]))


def _unknown_model(path: Path, where: str, model: str) -> tuple[str, int]:
    known = ", ".join(PARAMETERS)
    raise DataError(f"{path}: {where}: field 'model' is {model!r:.40}, expected one of {known}. Undistort the model.")


def _images_binary(path: Path) -> Iterator[ImageRow]:
    file = _Binary(path)
    for where in file.records("images"):
        number, *pose, camera = file.take(_IMAGE, where)
        name = file.name(where)
        where = f"{where} '{name}'"
        (count,) = file.take(_COUNT, where)
        keypoints = file.table(_KEYPOINT, count, f"{where}: keypoints")
        seen = keypoints[keypoints["point"] != NO_POINT]
        xy = np.stack((seen["x"], seen["y"]), 1)
        yield ImageRow(where, number, np.array(pose), camera, name, xy, _ids(path, seen["point"]))


def _images_text(path: Path) -> Iterator[ImageRow]:
    rows = _rows(path)
    for where, words in rows:
        if not words:
            continue
        if len(words) < _IMAGE_WORDS:
            raise DataError(
                f"{path}: {where}: expected ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {len(words)} words."
            )
        number, camera = (_whole(path, where, words[i]) for i in (0, 8))
        pose, name = _numbers(path, where, words[1:8]), " ".join(words[_IMAGE_WORDS - 1 :])
        # Its keypoints stand on the next line, which may be empty, or missing at the end of the file.
        below, keypoints = next(rows, (where, []))
        if len(keypoints) % 3:
            raise DataError(f"{path}: {below}: keypoints: expected triples X Y POINT3D_ID, got {len(keypoints)} words.")
        table = _numbers(path, below, keypoints).reshape(-1, 3)
        seen = table[table[:, 2] != -1]
        yield ImageRow(f"{where} '{name}'", number, pose, camera, name, seen[:, :2].copy(), _ids(path, seen[:, 2]))


def _points_binary(path: Path) -> Iterator[tuple[tuple, int]]:
    file = _Binary(path)
    for where in file.records("points3D"):
        *row, track = file.take(_POINT, where)
        file.table(_TRACK, track, f"{where}: field 'track'")
        yield tuple(row), track


def _points_text(path: Path) -> Iterator[tuple[np.ndarray, int]]:
    for where, words in _rows(path):
        track, odd = divmod(len(words) - _POINT_COLUMNS, 2)
        if words and (track < 0 or odd):
            raise DataError(
                f"{path}: {where}: expected POINT3D_ID X Y Z R G B ERROR and pairs of a track, got {len(words)} words."
            )
        if words:
            yield _numbers(path, where, words)[:_POINT_COLUMNS], track


def _rows(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Name and words of every line that is no comment; empty ones too, they mean something in ``images.txt``."""
    for number, raw in enumerate(_contents(path).split(b"\n"), 1):
        line = _decoded(path, raw, f"line {number}").strip()
        if not line.startswith("#"):
            yield f"line {number}", line.split()


def _contents(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}). Expected a file of a COLMAP model.") from error


def _decoded(path: Path, raw: bytes, where: str) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: {where}: is no UTF-8 text ({error.reason}). Export the model again.") from error


def _whole(path: Path, where: str, word: str) -> int:
    # ASCII digits only: int() also takes underscores and other alphabets' digits.
    if not (word.isascii() and word.isdigit()) or len(word) > 18:
        raise DataError(f"{path}: {where}: expected a whole number, got {word!r:.40}.")
    return int(word)


def _numbers(path: Path, where: str, words: list[str]) -> np.ndarray:
    try:
        return np.array(words, np.float64)
    except ValueError as error:
        raise DataError(f"{path}: {where}: expected a number ({error!s:.80}).") from None


def _ids(path: Path, values: np.ndarray) -> np.ndarray:
    """Ids (n,) as int64, after checking that they are such: whole, not negative, below 2^53."""
    if not ((values == np.floor(values)) & (values >= 0) & (values < 1 << 53)).all():
        raise DataError(f"{path}: a point's id is no whole number from 0 to 2^53. Export the model again.")
    return values.astype(np.int64)
