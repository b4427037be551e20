"""Frames of one sequence as memory maps: ``view_0.npy``, ``view_1.npy``, ... and ``frames.json``.

Of each view only the bounding box of its foreground over all frames is stored, (F, h, w, 4) straight-alpha RGBA.
Pixels outside are transparent. Frames are read on request without decoding.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
import torch
from jaxtyping import UInt8
from msgspec import Meta, Struct
from torch import Tensor

from gausim.core import Cameras, DataError
from gausim.io.files import replacing, write_json
from gausim.io.plain_json import checked, read_json

HEADER = "frames.json"
_Side = Annotated[int, Meta(ge=0, le=1 << 16)]
_Row = tuple[float, float, float]
_LongRow = tuple[float, float, float, float]


class _View(Struct):
    name: str
    left: _Side  # first stored column [pixels]
    top: _Side  # first stored row [pixels]
    viewmat: tuple[_LongRow, _LongRow, _LongRow, _LongRow]
    K: tuple[_Row, _Row, _Row]


class _Header(Struct):
    schema: Literal[2]
    width: _Side
    height: _Side
    fps: Annotated[float, Meta(gt=0)]
    views: Annotated[list[_View], Meta(min_length=1)]


@dataclass(frozen=True, eq=False)
class PackedFrames:
    """A sequence's header."""

    folder: Path  # folder of the files
    count: int  # number of frames
    fps: float  # frames per second
    cameras: Cameras  # one per view
    corners: tuple[tuple[int, int], ...]  # first stored row and column of each view
    size: int  # of all pixels [bytes]

    def read(self, frames: range, columns: Sequence[int]) -> UInt8[Tensor, "F V H W 4"]:
        """Full images of consecutive frames of these views, transparent black outside the stored boxes.

        Only the requested bytes are read, and they are not cached.
        """
        images = np.zeros((len(frames), len(columns), self.cameras.height, self.cameras.width, 4), np.uint8)
        for i, column in enumerate(columns):
            stored, (top, left) = _pixels(self.folder, column), self.corners[column]
            height, width = stored.shape[1:3]
            images[:, i, top : top + height, left : left + width] = stored[frames.start : frames.stop]
        return torch.from_numpy(images)


def is_packed(folder: Path) -> bool:
    """Whether a sequence's folder contains packed frames."""
    return (folder / HEADER).is_file()


def read_packed(folder: Path) -> PackedFrames:
    """Reads ``frames.json`` and checks it against the shapes of the views.

    Raises:
        DataError: a file is missing or a field is wrong; names the file and the field.
    """
    path = folder / HEADER
    found = checked(read_json(path), _Header, str(path), "Pack the sequence again.")
    names = tuple(view.name for view in found.views)
    stored = [_pixels(folder, number) for number in range(len(names))]
    for view, pixels in zip(found.views, stored, strict=True):
        count, height, width = pixels.shape[:3]
        if view.left + width > found.width or view.top + height > found.height or count != len(stored[0]):
            raise DataError(
                f"{path}: '{view.name}': expected {len(stored[0])} frames inside {found.width} x {found.height}, "
                f"got {count} of {width} x {height} from ({view.left}, {view.top}) on. Pack the sequence again."
            )
        if min(view.K[0][0], view.K[1][1]) <= 0 or view.K[2] != (0, 0, 1):
            raise DataError(f"{path}: '{view.name}': field 'K' must have positive focal lengths and end in 0 0 1.")
    viewmats, lenses = (torch.tensor([getattr(view, key) for view in found.views]) for key in ("viewmat", "K"))
    cameras = Cameras(viewmats, lenses, found.width, found.height, names).validated(str(path))
    corners = tuple((view.top, view.left) for view in found.views)
    return PackedFrames(folder, len(stored[0]), found.fps, cameras, corners, sum(pixels.nbytes for pixels in stored))


def write_packed(
    folder: Path, cameras: Cameras, views: Iterable[UInt8[np.ndarray, "F H W 4"]], fps: float, *, margin: int
) -> None:
    """Writes one sequence; ``frames.json``, which completes it, is written last and atomically.

    The views are the straight-alpha RGBA of each camera, requested one by one; ``margin`` is the number of transparent
    pixels stored around the bounding box of the foreground.

    Raises:
        DataError: a view has another size than its camera or another number of frames than the first.
    """
    corners, count = [], 0
    for number, pixels in enumerate(views):
        count = count or len(pixels)
        expected = (count, cameras.height, cameras.width, 4)
        if number >= len(cameras.names) or pixels.shape != expected:
            raise DataError(f"{folder}: view {number}: expected frames of shape {expected}, got {pixels.shape}.")
        rows, columns = bounding_box(pixels[..., 3], margin)
        with replacing(view_path(folder, number)) as temporary, temporary.open("wb") as file:
            np.save(file, pixels[:, rows, columns])
        corners.append((rows.start, columns.start))
    write_header(folder, cameras, corners, fps)


def write_header(folder: Path, cameras: Cameras, corners: Sequence[tuple[int, int]], fps: float) -> None:
    """Writes ``frames.json``; ``corners`` are the first stored row and column of each view."""
    poses = zip(cameras.names, corners, cameras.viewmats.tolist(), cameras.Ks.tolist(), strict=True)
    views = [_View(name, left, top, viewmat, k) for name, (top, left), viewmat, k in poses]
    write_json(folder / HEADER, msgspec.to_builtins(_Header(2, cameras.width, cameras.height, fps, views)))


def view_path(folder: Path, number: int) -> Path:
    """File of the pixels of a view."""
    return folder / f"view_{number}.npy"


def bounding_box(alpha: UInt8[np.ndarray, "F H W"], margin: int) -> tuple[slice, slice]:
    """Rows and columns of all pixels with alpha > 0 in any frame, and ``margin`` pixels around; empty without any."""
    x, y, width, height = cv2.boundingRect(np.any(alpha > 0, axis=0).astype(np.uint8))
    if not width:
        return slice(0, 0), slice(0, 0)
    rows = slice(max(0, y - margin), min(alpha.shape[1], y + height + margin))
    return rows, slice(max(0, x - margin), min(alpha.shape[2], x + width + margin))


def _pixels(folder: Path, number: int) -> np.ndarray:
    path = view_path(folder, number)
    try:
        stored = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # numpy raises many kinds of exceptions on damaged headers
        raise DataError(f"{path}: cannot be read ({error!s:.200}). Pack the sequence again.") from error
    if stored.dtype != np.uint8 or stored.ndim != 4 or stored.shape[3] != 4 or not len(stored):
        raise DataError(f"{path}: expected uint8 of shape (F, h, w, 4), got {stored.dtype} {stored.shape}.")
    return stored
