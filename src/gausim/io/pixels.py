"""Decoding of image files by OpenCV, after a check of the declared size, which a damaged file may exaggerate."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

# Tag of the sub-directory of EXIF data.
_EXIF = 0x8769


def decode(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray | None:
    """Pixels of an image as ``cv2.imread`` gives them (BGR, rows first); None where it cannot be decoded."""
    if not _is_whole(path):
        return None
    try:
        return cv2.imread(str(path), flags)
    except (cv2.error, MemoryError):
        return None


def _is_whole(path: Path) -> bool:
    """Whether the header and, where the format has them, all checksums are right.

    OpenCV makes room for whatever length a damaged part states.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                image.verify()
        return True
    except Exception:  # Pillow's readers raise many kinds of exceptions on damaged files
        return False


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
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                tags = image.getexif()
                exif = {**tags, **tags.get_ifd(_EXIF)}
                return ImageHeader(image.width, image.height, image.mode, exif)
    except Exception:  # Pillow's readers raise many kinds of exceptions on damaged files
        return None
