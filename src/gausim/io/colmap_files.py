"""The three files of a COLMAP sparse model as records, binary or text; :mod:`gausim.io.colmap` says what they mean.

Nothing is believed: a count is compared with the bytes that are left before anything is allocated for it, and what is
read takes at most twice the bytes of a binary file; of a text, whose numbers may be short, four times.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

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
_KEYPOINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
_TRACK_BYTES = 8
_SMALLEST_CAMERA = _CAMERA.size + 3 * 8
_SMALLEST_IMAGE = _IMAGE.size + 2 + _COUNT.size
_POINT_COLUMNS = 8
_IMAGE_WORDS = 10
_WORD = re.compile(r"\S+")


@dataclass(frozen=True, eq=False)
class CameraRecord:
    """One line of ``cameras``: ``where`` is what messages call it, ``params`` are (p,) float64."""

    where: str
    number: int
    model: str
    width: int
    height: int
    params: np.ndarray


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """One entry of ``images``: quaternion (4,) w x y z, translation (3,), and the keypoints that show a point.

    ``xy`` is (m, 2) float64 [pixels], ``point_ids`` (m,) int64.
    """

    where: str
    number: int
    quaternion: np.ndarray
    translation: np.ndarray
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


def read_cameras(path: Path) -> Iterator[CameraRecord]:
    """The cameras of ``cameras.bin`` or ``cameras.txt``.

    Raises:
        DataError: naming the file, the camera and the field that is cut off, malformed or of an unknown model.
    """
    return _cameras_binary(path) if path.suffix == ".bin" else _cameras_text(path)


def read_images(path: Path) -> Iterator[ImageRecord]:
    """The images of ``images.bin`` or ``images.txt``; raises like :func:`read_cameras`."""
    return _images_binary(path) if path.suffix == ".bin" else _images_text(path)


def read_points(path: Path) -> PointTable:
    """The points of ``points3D.bin`` or ``points3D.txt``; raises like :func:`read_cameras`."""
    return _points_binary(path) if path.suffix == ".bin" else _points_text(path)


class _Bytes:
    """A binary file that is read forward, with an error where it ends too early."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, 0
        self.data = _contents(path)

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def take(self, layout: struct.Struct, where: str) -> tuple:
        self.need(layout.size, where)
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def need(self, count: int, where: str) -> None:
        if count > self.left:
            raise DataError(
                f"{self.path}: {where}: expected {count} more bytes, the file has {self.left}. It is truncated or its "
                "counts are wrong; copy or export the model again."
            )

    def count(self, where: str, smallest: int) -> int:
        """A number of records, of which each takes at least ``smallest`` bytes."""
        (value,) = self.take(_COUNT, where)
        self.need(value * smallest, where)
        return int(value)

    def table(self, dtype: np.dtype, count: int, where: str) -> np.ndarray:
        self.need(count * dtype.itemsize, where)
        values = np.frombuffer(self.data, dtype, count, self.at)
        self.at += count * dtype.itemsize
        return values

    def name(self, where: str) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise DataError(f"{self.path}: {where}: field 'name' has no end. The file is truncated; export it again.")
        raw, self.at = self.data[self.at : end], end + 1
        return _decoded(self.path, raw, f"{where}: field 'name'")

    def end(self) -> None:
        if self.left:
            raise DataError(
                f"{self.path}: {self.left} bytes follow the last record. The counts are wrong; export the model again."
            )


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


def _cameras_binary(path: Path) -> Iterator[CameraRecord]:
    file = _Bytes(path)
    for i in range(file.count("number of cameras", _SMALLEST_CAMERA)):
        where = f"cameras[{i}]"
        number, model, width, height = file.take(_CAMERA, where)
        if model not in MODELS:
            raise _unknown_model(path, where, str(model))
        name, count = MODELS[model]
        params = file.table(np.dtype("<f8"), count, f"{where}: field 'params' of {name}").copy()
        yield CameraRecord(where, number, name, width, height, params)
    file.end()


def _cameras_text(path: Path) -> Iterator[CameraRecord]:
    for i, (where, line) in enumerate(_lines(path)):
        words = line.split()
        if not words:
            continue
        if len(words) < 2:
            raise DataError(f"{path}: {where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], got {line!r:.60}.")
        if words[1] not in PARAMETERS:
            raise _unknown_model(path, where, words[1])
        expected = 4 + PARAMETERS[words[1]]
        if len(words) != expected:
            raise DataError(f"{path}: {where}: expected {expected} words for {words[1]}, got {len(words)}.")
        integers = [_integer(path, where, f, words[j]) for f, j in (("id", 0), ("width", 2), ("height", 3))]
        params = np.array([_number(path, f"{where}: field 'params'", word) for word in words[4:]])
        yield CameraRecord(f"cameras[{i}]", integers[0], words[1], integers[1], integers[2], params)


def _unknown_model(path: Path, where: str, model: str) -> DataError:
    known = ", ".join(PARAMETERS)
    return DataError(
        f"{path}: {where}: field 'model' is {model:.40}, expected one of {known}. Undistort the model in COLMAP."
    )


def _images_binary(path: Path) -> Iterator[ImageRecord]:
    file = _Bytes(path)
    for i in range(file.count("number of images", _SMALLEST_IMAGE)):
        where = f"images[{i}]"
        number, *pose, camera = file.take(_IMAGE, where)
        name = file.name(where)
        where = f"images[{i}] '{name}'"
        count = file.count(f"{where}: number of keypoints", _KEYPOINT.itemsize)
        keypoints = file.table(_KEYPOINT, count, f"{where}: keypoints")
        seen = keypoints[keypoints["point"] != NO_POINT]
        xy = np.stack((seen["x"], seen["y"]), 1)
        ids = _ids(path, f"{where}: keypoints", seen["point"])
        yield ImageRecord(where, number, np.array(pose[:4]), np.array(pose[4:]), camera, name, xy, ids)
    file.end()


def _images_text(path: Path) -> Iterator[ImageRecord]:
    lines, i = _lines(path), 0
    for where, line in lines:
        if not line:
            continue
        words = line.split(maxsplit=_IMAGE_WORDS - 1)
        if len(words) != _IMAGE_WORDS:
            raise DataError(
                f"{path}: {where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {len(words)} words."
            )
        number, camera = (_integer(path, where, f, words[j]) for f, j in (("id", 0), ("camera_id", 8)))
        pose = np.array([_number(path, f"{where}: pose", word) for word in words[1:8]])
        # Its keypoints stand on the next line, which may be empty, or missing at the end of the file.
        where, keypoints = next(lines, (where, ""))
        table = _numbers(path, f"{where}: keypoints", keypoints)
        if len(table) % 3:
            raise DataError(f"{path}: {where}: keypoints: expected triples X Y POINT3D_ID, got {len(table)} numbers.")
        table = table.reshape(-1, 3)
        seen = table[table[:, 2] != -1]
        ids = _ids(path, f"{where}: keypoints", seen[:, 2])
        label = f"images[{i}] '{words[9]}'"
        yield ImageRecord(label, number, pose[:4], pose[4:], camera, words[9], seen[:, :2].copy(), ids)
        i += 1


def _points_binary(path: Path) -> PointTable:
    file = _Bytes(path)
    count = file.count("number of points", _POINT.size)
    table = PointTable(
        np.empty(count, np.int64), np.empty((count, 3)), np.empty((count, 3), np.uint8), np.empty(count),
        np.empty(count, np.int64),
    )  # fmt: skip
    for i in range(count):
        where = f"points3D[{i}]"
        number, x, y, z, r, g, b, error, track = file.take(_POINT, where)
        if number >= 1 << 63:
            raise DataError(f"{path}: {where}: field 'id' is {number}, expected less than 2^63.")
        file.need(track * _TRACK_BYTES, f"{where}: field 'track'")
        file.at += track * _TRACK_BYTES
        table.ids[i], table.xyz[i], table.rgb[i] = number, (x, y, z), (r, g, b)
        table.error[i], table.tracks[i] = error, track
    file.end()
    return table


def _points_text(path: Path) -> PointTable:
    values, tracks = array("d"), array("q")
    for where, line in _lines(path):
        numbers = _numbers(path, where, line)
        if not len(numbers):
            continue
        track, odd = divmod(len(numbers) - _POINT_COLUMNS, 2)
        if track < 0 or odd:
            raise DataError(
                f"{path}: {where}: expected POINT3D_ID X Y Z R G B ERROR and pairs of a track, got {len(numbers)} "
                "numbers. Export the model again."
            )
        values.frombytes(numbers[:_POINT_COLUMNS].tobytes())
        tracks.append(track)
    table = np.frombuffer(values, np.float64).reshape(-1, _POINT_COLUMNS) if values else np.empty((0, _POINT_COLUMNS))
    rgb = table[:, 4:7]
    if not ((rgb >= 0) & (rgb <= 255) & (rgb == np.floor(rgb))).all():
        raise DataError(f"{path}: field 'rgb' must hold whole numbers from 0 to 255. Export the model again.")
    ids = _ids(path, "points3D", table[:, 0])
    return PointTable(ids, table[:, 1:4], rgb.astype(np.uint8), table[:, 7], np.array(tracks, np.int64))


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Name and text of every line that is no comment; empty ones too, they mean something in ``images.txt``."""
    try:
        with path.open("rb") as file:
            for number, raw in enumerate(file, 1):
                line = _decoded(path, raw, f"line {number}").strip()
                if not line.startswith("#"):
                    yield f"line {number}", line
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}). Expected a file of a COLMAP model.") from error


def _integer(path: Path, where: str, field: str, word: str) -> int:
    # ASCII digits only: int() also takes underscores and other alphabets' digits.
    if not (word.isascii() and word.isdigit()) or len(word) > 18:
        raise DataError(f"{path}: {where}: field '{field}' must be a whole number, got {word!r:.40}.")
    return int(word)


def _number(path: Path, where: str, word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise DataError(f"{path}: {where}: expected a number, got {word!r:.40}.") from None


def _numbers(path: Path, where: str, line: str) -> np.ndarray:
    """All numbers of a line (n,) float64; no list of its words, which would take many times the file's memory."""
    try:
        values = array("d", (float(word[0]) for word in _WORD.finditer(line)))
    except ValueError as error:
        raise DataError(f"{path}: {where}: expected numbers only ({error!s:.80}).") from None
    return np.frombuffer(values, np.float64) if values else np.empty(0)


def _ids(path: Path, where: str, values: np.ndarray) -> np.ndarray:
    """Ids (n,) as int64, after checking that they are such: whole, not negative, below 2^63 (2^53 in text)."""
    whole = values == np.floor(values) if values.dtype.kind == "f" else np.ones(len(values), bool)
    # Comparisons with NaN are false, so it is refused too.
    limit = 1 << 53 if values.dtype.kind == "f" else np.uint64(1 << 63)
    if not (whole & (values >= 0) & (values < limit)).all():
        raise DataError(f"{path}: {where}: a point's id is no whole number from 0 on. Export the model again.")
    return values.astype(np.int64)
