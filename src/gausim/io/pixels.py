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

# Tag of the sub-directory of EXIF data.
_EXIF = 0x8769


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
    return ImageHeader(image.width, image.height, image.mode, {**tags, **tags.get_ifd(_EXIF)})


def _is_whole(image: Image) -> bool:
    image.verify()  # raises otherwise
    return True
