"""Frames of one sequence in two files: ``frames.bin``, 8-bit pixels as they lie in memory, and ``frames.json``.

A view holds only the part of the image that its foreground ever touches, all frames one after the other: a block of
(F, h, w, 4) bytes, straight-alpha RGBA, from ``offset`` on. Outside it everything is transparent. Frames are read where
they are needed; nothing is decoded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from gausim.core import Cameras, DataError
from gausim.io.transforms import positive_field, read_json

SCHEMA = 1
HEADER, PIXELS = "frames.json", "frames.bin"
# Of a header; sequences beyond these sizes are a broken file rather than a film.
MOST_FRAMES, MOST_PIXELS = 1_000_000, 1 << 16


@dataclass(frozen=True)
class Crop:
    """The part of a view that is stored.

    Attributes:
        left: first column [pixels].
        top: first row [pixels].
        width: of the part; 0 where the view never shows any foreground.
        height: of the part.
        offset: of its first byte in ``frames.bin``.
    """

    left: int
    top: int
    width: int
    height: int
    offset: int

    @property
    def frame_bytes(self) -> int:
        """Size of one frame."""
        return 4 * self.width * self.height


@dataclass(frozen=True, eq=False)
class PackedFrames:
    """A sequence's header.

    Attributes:
        folder: where both files lie.
        count: number of frames.
        fps: frames per second.
        cameras: one per view.
        crops: one per view.
        size: of ``frames.bin`` [bytes].
        sha256: of ``frames.bin``.
    """

    folder: Path
    count: int
    fps: float
    cameras: Cameras
    crops: tuple[Crop, ...]
    size: int
    sha256: str

    def read(self, frames: range, columns: Sequence[int]) -> UInt8[Tensor, "F V H W 4"]:
        """Whole images of consecutive frames of these views, transparent black outside the crops.

        Only the bytes asked for are read, and nothing stays in memory.
        """
        path, (height, width) = self.folder / PIXELS, (self.cameras.height, self.cameras.width)
        images = np.zeros((len(frames), len(columns), height, width, 4), np.uint8)
        try:
            stored = np.memmap(path, np.uint8, mode="r", shape=(self.size,)) if self.size else np.empty(0, np.uint8)
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: cannot be read ({error}). `gausim verify` tells what is wrong.") from error
        for row, column in enumerate(columns):
            crop = self.crops[column]
            begin, end = (crop.offset + frame * crop.frame_bytes for frame in (frames.start, frames.stop))
            pixels = stored[begin:end].reshape(len(frames), crop.height, crop.width, 4)
            images[:, row, crop.top : crop.top + crop.height, crop.left : crop.left + crop.width] = pixels
        return torch.from_numpy(images)


def is_packed(folder: Path) -> bool:
    """Whether a sequence's folder holds packed frames."""
    return (folder / HEADER).is_file()


def read_packed(folder: Path) -> PackedFrames:
    """Reads and checks ``frames.json`` against the size of ``frames.bin``.

    Raises:
        DataError: a file is missing or a field is wrong; names both.
    """
    path = folder / HEADER
    data = read_json(path)
    if data.get("schema") != SCHEMA:
        raise DataError(f"{path}: schema is {data.get('schema')!r}, expected {SCHEMA}. Pack the sequence again.")
    count = _integer(data, "frames", path, 1, MOST_FRAMES)
    width, height = (_integer(data, key, path, 1, MOST_PIXELS) for key in ("width", "height"))
    fps, size = positive_field(data, "fps", str(path)), _integer(data, "bytes", path, 0, 1 << 62)
    content = data.get("sha256")
    if not isinstance(content, str) or len(content) != 64:
        raise DataError(f"{path}: field 'sha256' must be 64 hexadecimal digits, got {content!r}.")
    views = data.get("views")
    if not isinstance(views, list) or not views or not all(isinstance(v, dict) for v in views):
        raise DataError(f"{path}: field 'views' must be a non-empty list of objects.")
    crops = tuple(_crop(view, f"{path}: views[{i}]", (width, height), count, size) for i, view in enumerate(views))
    cameras = _cameras(views, path, width, height)
    pixels = folder / PIXELS
    if not pixels.is_file() or pixels.stat().st_size != size:
        found = f"{pixels.stat().st_size} bytes" if pixels.is_file() else "no such file"
        raise DataError(f"{pixels}: expected {size} bytes as {HEADER} says, got {found}. Pack the sequence again.")
    return PackedFrames(folder, count, fps, cameras, crops, size, content)


def _integer(data: dict[str, Any], key: str, where: Path | str, low: int, high: int) -> int:
    value = data.get(key)
    if type(value) is not int or not low <= value <= high:
        raise DataError(f"{where}: field '{key}' must be an integer from {low} to {high}, got {value!r}.")
    return value


def _crop(view: dict[str, Any], where: str, size: tuple[int, int], count: int, total: int) -> Crop:
    box = view.get("crop")
    if not isinstance(box, list) or len(box) != 4 or not all(type(x) is int and x >= 0 for x in box):
        raise DataError(f"{where}: field 'crop' must be four integers (left, top, width, height), got {box!r}.")
    left, top, width, height = box
    crop = Crop(left, top, width, height, _integer(view, "offset", where, 0, total))
    if crop.left + crop.width > size[0] or crop.top + crop.height > size[1]:
        raise DataError(f"{where}: field 'crop' {box} leaves the image of {size[0]}x{size[1]}.")
    if crop.offset + count * crop.frame_bytes > total:
        raise DataError(
            f"{where}: {count} frames of {crop.frame_bytes} bytes from {crop.offset} on leave the {total} bytes that "
            "field 'bytes' states."
        )
    return crop


def _cameras(views: list[dict[str, Any]], path: Path, width: int, height: int) -> Cameras:
    names = [view.get("name") for view in views]
    if not all(isinstance(name, str) for name in names) or len(set(names)) != len(names):
        raise DataError(f"{path}: field 'name' of the views must be different texts, got {names}.")
    stacked = [torch.stack([_matrix(view, key, side, f"{path}: views[{i}]") for i, view in enumerate(views)])
               for key, side in (("viewmat", 4), ("K", 3))]  # fmt: skip
    return Cameras(stacked[0], stacked[1], width, height, tuple(map(str, names))).validated(str(path))


def _matrix(view: dict[str, Any], key: str, side: int, where: str) -> Tensor:
    try:
        found = torch.tensor(view.get(key), dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        found = torch.empty(0)
    if found.shape != (side, side) or not torch.isfinite(found).all():
        raise DataError(f"{where}: field '{key}' must be a finite {side} x {side} matrix.")
    if key == "K" and (found.diag().min() <= 0 or found[2].tolist() != [0, 0, 1]):
        raise DataError(f"{where}: field 'K' must have positive focal lengths and end in 0 0 1.")
    return found.float()
