"""Decoding of image files by OpenCV, after checks of declared sizes, which a damaged file may exaggerate."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import cv2
import numpy as np

if TYPE_CHECKING:
    from PIL.Image import Image

T = TypeVar("T")

# Tags of the EXIF standard: its sub-directory, and how the picture is to be turned; a quarter by these.
_EXIF, ORIENTATION = 0x8769, 0x0112
QUARTER_TURNS = (5, 6, 7, 8)


def decode(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray | None:
    """Pixels of an image as ``cv2.imread`` gives them (BGR, rows first); None where it cannot be decoded.

    Checksums come first, where the format has them: OpenCV makes room for whatever length a damaged part states.
    """
    if not _opened(path, _is_whole):
        return None
    try:
        return cv2.imread(str(path), flags)
    except (cv2.error, MemoryError):
        return None


def palette_indices(path: Path) -> np.ndarray | None:
    """(H, W) numbers of the colours of a picture that has a palette without transparency; None for other pictures."""
    return _opened(path, lambda image: np.asarray(image) if _has_palette(image) else None)


def decode_tiff(path: Path) -> np.ndarray | None:
    """(H, W, 3) BGR or (H, W, 4) BGRA of a TIFF that is to be turned, as stored; OpenCV cannot read these."""

    def read(image: Image) -> np.ndarray:
        orientation = image.getexif().get(ORIENTATION) or 1  # Pillow turns a TIFF when it loads it
        pixels = np.asarray(image.convert("RGBA" if "A" in image.mode else "RGB"))
        stored = exif_turned(pixels, {6: 8, 8: 6}.get(orientation, orientation))
        return np.ascontiguousarray(stored[..., [2, 1, 0, 3][: stored.shape[2]]])

    return _opened(path, read)


def exif_turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """A stored picture (H, W, C) as its EXIF orientation turns it."""
    turns: dict[int, Callable[[np.ndarray], np.ndarray]] = {
        2: lambda p: p[:, ::-1], 3: lambda p: p[::-1, ::-1], 4: lambda p: p[::-1], 5: lambda p: p.swapaxes(0, 1),
        6: lambda p: np.rot90(p, -1), 7: lambda p: p[::-1, ::-1].swapaxes(0, 1), 8: np.rot90,
    }  # fmt: skip
    return np.ascontiguousarray(turns[orientation](pixels)) if orientation in turns else pixels


def _has_palette(image: Image) -> bool:
    return image.mode == "P" and "transparency" not in image.info


@dataclass(frozen=True)
class ImageHeader:
    """Header of an image file."""

    width: int  # as stored [pixels]
    height: int  # as stored [pixels]
    mode: str  # Pillow's name of the channels, e.g. ``RGBA``
    exif: Mapping[int, Any]  # EXIF entries by tag, including those of the sub-directory


def read_header(path: Path) -> ImageHeader | None:
    """Reads the header of an image file without decoding it; None if the file is not an image.

    None also above 178 million pixels, where Pillow considers the header damaged.
    """
    return _opened(path, _header)


def _opened(path: Path, read: Callable[[Image], T]) -> T | None:
    """What is read from an image that Pillow has opened but not decoded; None where it raises anything."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                return read(image)
    except Exception:  # Pillow's readers raise many kinds of exceptions on damaged files
        return None


def _header(image: Image) -> ImageHeader:
    tags = image.getexif()
    # Pillow tells the size of a TIFF after the turn.
    swapped = image.format == "TIFF" and tags.get(ORIENTATION) in QUARTER_TURNS
    width, height = (image.height, image.width) if swapped else (image.width, image.height)
    return ImageHeader(width, height, image.mode, {**tags, **tags.get_ifd(_EXIF)})


def _is_whole(image: Image) -> bool:
    image.verify()  # raises otherwise
    return True
