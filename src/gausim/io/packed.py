"""Frames of one sequence in two files: ``frames.bin``, 8-bit pixels as they lie in memory, and ``frames.json``.

Of each view only the bounding box of its foreground over all frames is stored: a block of (F, h, w, 4) bytes,
straight-alpha RGBA, from ``offset`` on. Pixels outside are transparent. Frames are read on request without decoding.
"""

from __future__ import annotations

import hashlib
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
from gausim.io.files import replacing, write_durably
from gausim.io.plain_json import checked, read_json

HEADER, PIXELS = "frames.json", "frames.bin"
# Larger sizes indicate a damaged file.
_Count = Annotated[int, Meta(ge=1, le=1_000_000)]
_Side = Annotated[int, Meta(ge=1, le=1 << 16)]
_Natural = Annotated[int, Meta(ge=0, le=1 << 62)]
_Row = tuple[float, float, float]
_LongRow = tuple[float, float, float, float]


class _View(Struct):
    name: str
    crop: tuple[_Natural, _Natural, _Natural, _Natural]  # left, top, width, height
    offset: _Natural
    viewmat: tuple[_LongRow, _LongRow, _LongRow, _LongRow]
    K: tuple[_Row, _Row, _Row]


class _Header(Struct):
    schema: Literal[1]
    frames: _Count
    width: _Side
    height: _Side
    fps: Annotated[float, Meta(gt=0)]
    bytes: _Natural
    sha256: Annotated[str, Meta(min_length=64, max_length=64)]
    views: Annotated[list[_View], Meta(min_length=1)]


@dataclass(frozen=True)
class Crop:
    """The stored part of a view."""

    left: int  # first column [pixels]
    top: int  # first row [pixels]
    width: int  # of the part [pixels]; 0 if the view has no foreground
    height: int  # of the part
    offset: int  # of its first byte in ``frames.bin``

    @property
    def frame_bytes(self) -> int:
        """Size of one frame."""
        return 4 * self.width * self.height


@dataclass(frozen=True, eq=False)
class PackedFrames:
    """A sequence's header."""

    folder: Path  # folder of both files
    count: int  # number of frames
    fps: float  # frames per second
    cameras: Cameras  # one per view
    crops: tuple[Crop, ...]  # one per view
    size: int  # of ``frames.bin`` [bytes]
    sha256: str  # of ``frames.bin``

    def read(self, frames: range, columns: Sequence[int]) -> UInt8[Tensor, "F V H W 4"]:
        """Full images of consecutive frames of these views, transparent black outside the crops.

        Only the requested bytes are read, and they are not cached.
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
    """Whether a sequence's folder contains packed frames."""
    return (folder / HEADER).is_file()


def read_packed(folder: Path) -> PackedFrames:
    """Reads and checks ``frames.json`` against the size of ``frames.bin``.

    Raises:
        DataError: a file is missing or a field is wrong; names the file and the field.
    """
    path, pixels, remedy = folder / HEADER, folder / PIXELS, "Pack the sequence again."
    found = checked(read_json(path), _Header, str(path), remedy)
    names, crops = tuple(view.name for view in found.views), []
    if len(set(names)) != len(names):
        raise DataError(f"{path}: field 'name' of the views must be different texts, got {names}. {remedy}")
    for view in found.views:
        crops.append(crop := Crop(*view.crop, view.offset))
        if crop.left + crop.width > found.width or crop.top + crop.height > found.height:
            raise DataError(f"{path}: '{view.name}': field 'crop' {view.crop} leaves the image. {remedy}")
        if crop.offset + found.frames * crop.frame_bytes > found.bytes:
            raise DataError(
                f"{path}: '{view.name}': its frames from 'offset' on leave the {found.bytes} bytes. {remedy}"
            )
        if min(view.K[0][0], view.K[1][1]) <= 0 or view.K[2] != (0, 0, 1):
            raise DataError(f"{path}: '{view.name}': field 'K' must have positive focal lengths and end in 0 0 1.")
    size = pixels.stat().st_size if pixels.is_file() else None
    if size != found.bytes:
        raise DataError(f"{pixels}: expected {found.bytes} bytes as {HEADER} says, got {size or 'none'}. {remedy}")
    viewmats, lenses = (torch.tensor([getattr(view, key) for view in found.views]) for key in ("viewmat", "K"))
    cameras = Cameras(viewmats, lenses, found.width, found.height, names).validated(str(path))
    return PackedFrames(folder, found.frames, found.fps, cameras, tuple(crops), found.bytes, found.sha256)


def write_packed(
    folder: Path, cameras: Cameras, views: Iterable[UInt8[np.ndarray, "F H W 4"]], fps: float, *, margin: int
) -> None:
    """Writes one sequence; ``frames.json``, which completes it, is written last and atomically.

    The views are the straight-alpha RGBA of each camera, requested one by one; ``margin`` is the number of transparent
    pixels stored around the bounding box of the foreground.

    Raises:
        DataError: a view has another size than its camera or another number of frames than the first.
    """
    crops: list[Crop] = []
    digest, offset, count = hashlib.sha256(), 0, 0
    with replacing(folder / PIXELS) as temporary, temporary.open("wb") as file:
        for number, pixels in enumerate(views):
            count = count or len(pixels)
            expected = (count, cameras.height, cameras.width, 4)
            if number >= len(cameras.names) or pixels.shape != expected:
                raise DataError(f"{folder}: view {number}: expected frames of shape {expected}, got {pixels.shape}.")
            crop = bounding_crop(pixels[..., 3], margin, offset)
            for frame in pixels[:, crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]:
                content = frame.tobytes()
                file.write(content)
                digest.update(content)
            crops.append(crop)
            offset += count * crop.frame_bytes
    text = header(cameras, crops, count=count, fps=fps, size=offset, sha256=digest.hexdigest())
    write_durably(folder / HEADER, text)


def bounding_crop(alpha: UInt8[np.ndarray, "F H W"], margin: int, offset: int) -> Crop:
    """The bounding box of all pixels with alpha > 0 in any frame, enlarged by ``margin`` pixels."""
    x, y, width, height = cv2.boundingRect(np.any(alpha > 0, axis=0).astype(np.uint8))
    if not width:
        return Crop(0, 0, 0, 0, offset)
    left, top = max(0, x - margin), max(0, y - margin)
    bottom, right = min(alpha.shape[1], y + height + margin), min(alpha.shape[2], x + width + margin)
    return Crop(left, top, right - left, bottom - top, offset)


def header(cameras: Cameras, crops: Sequence[Crop], *, count: int, fps: float, size: int, sha256: str) -> bytes:
    """The content of ``frames.json``."""
    views = [
        _View(name, (crop.left, crop.top, crop.width, crop.height), crop.offset, viewmat, k)
        for name, crop, viewmat, k in zip(
            cameras.names, crops, cameras.viewmats.tolist(), cameras.Ks.tolist(), strict=True
        )
    ]
    facts = _Header(1, count, cameras.width, cameras.height, fps, size, sha256, views)
    return msgspec.json.format(msgspec.json.encode(facts), indent=1) + b"\n"
