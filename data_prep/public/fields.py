"""Fields of the public sets' files, checked: a :class:`DataError` names file and field of what is not as expected."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.common.photos import open_photo
from gausim.core.errors import DataError
from gausim.io.plain_json import checked, read_any_json

# Larger numbers indicate damage: they would overflow float32 in later computations.
_LARGEST = 1e9
# A rotation read from six-digit text is orthonormal to about 1e-5.
_ROTATION_TOLERANCE = 1e-3
# Columns of pixels may stand askew by this fraction of the focal length before it shows.
_SKEW = 1e-3
# Steps of time may differ by this fraction of a frame.
_UNEVEN = 0.01
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
REMEDY = "Take the file that the set's authors publish."


def read_record(path: Path, kind: Any) -> Any:
    """The content of a JSON file, converted to a type."""
    return checked(read_any_json(path), kind, str(path), REMEDY)


def rate_of(times: list[float], where: str) -> float:
    """Frames per second by the times of the frames [s]."""
    steps = np.diff(numbers(times, (-1,), where))
    if len(steps) == 0 or steps.min() <= 0 or np.ptp(steps) > _UNEVEN * steps.mean():
        raise DataError(f"{where}: expected times [s] that rise by equal steps, got {times[:4]}. State --fps.")
    return float(1 / steps.mean())


def numbers(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """A float64 array of this shape from nested lists or an array; −1 stands for any length but 0."""
    wrong = f"{where}: expected finite numbers of shape ({', '.join('?' if n < 0 else str(n) for n in shape)})"
    try:
        array = np.asarray(value)
    except ValueError:
        raise DataError(f"{wrong}, got rows of different lengths. {REMEDY}") from None
    fits = array.ndim == len(shape) and all(n == m or n < 0 < m for n, m in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "iuf":
        raise DataError(f"{wrong}, got {array.dtype} of shape {tuple(array.shape)}. {REMEDY}")
    if not (np.abs(array) <= _LARGEST).all():
        raise DataError(f"{wrong} up to {_LARGEST:g}, found NaN, infinity or more. {REMEDY}")
    return array.astype(np.float64)


def lens(value: Any, where: str) -> np.ndarray:
    """(3, 3) K [pixels] of a pinhole camera."""
    k = numbers(value, (3, 3), where)
    flat = abs(k[1, 0]) + abs(k[2, 0]) + abs(k[2, 1]) + abs(k[2, 2] - 1) < 1e-6
    if min(k[0, 0], k[1, 1]) <= 0 or not flat or abs(k[0, 1]) > _SKEW * k[0, 0]:
        raise DataError(
            f"{where}: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, got {k.tolist()}. {REMEDY}"
        )
    k[0, 1] = 0.0
    return k


def viewmat(value: Any, where: str, *, opengl: bool = False, inverse: bool = False) -> np.ndarray:
    """(4, 4) world to camera, OpenCV axes, of a pose (3 × 4 or 4 × 4).

    Args:
        value: the matrix.
        where: file and field.
        opengl: the camera's axes are x right, y up, z back.
        inverse: the matrix is camera to world.
    """
    rows = 3 if isinstance(value, list | np.ndarray) and len(value) == 3 else 4
    matrix = np.eye(4)
    matrix[:rows] = numbers(value, (rows, 4), where)
    turn = matrix[:3, :3]
    error = float(np.abs(turn @ turn.T - np.eye(3)).max())
    if error > _ROTATION_TOLERANCE or np.linalg.det(turn) < 0 or np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise DataError(
            f"{where}: expected a rotation and a translation (R Rᵀ − I is {error:.3g}, det R is "
            f"{np.linalg.det(turn):.3g}, the last row is {matrix[3].tolist()}). {REMEDY}"
        )
    if inverse:
        matrix[:3, 3] = -turn.T @ matrix[:3, 3]
        matrix[:3, :3] = turn.T
    return OPENGL_TO_OPENCV @ matrix if opengl else matrix


def check_name(name: str, where: str) -> str:
    """A camera's or a sequence's name, which becomes a folder."""
    if not _NAME.fullmatch(name):
        raise DataError(f"{where}: expected a name of letters, digits, '_', '.' and '-', got {name!r:.80}. {REMEDY}")
    return name


def numbered(paths: dict[int, Path], where: str) -> tuple[Path, ...]:
    """Frames by number, which must run from 0 without a gap."""
    gap = next((number for number in range(len(paths)) if number not in paths), None)
    if not paths or gap is not None:
        raise DataError(f"{where}: frame {gap or 0} is missing; expected frames from 0 on without a gap. Restore it.")
    return tuple(paths[number] for number in range(len(paths)))


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of a picture [pixels]."""
    photo = open_photo(path, path.name)
    return photo.width, photo.height
