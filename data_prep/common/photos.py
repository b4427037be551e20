"""Photos as the stages read them: which there are, their size and focal length, their pixels the right way up."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gausim.core.errors import DataError
from gausim.io.files import natural, write_durably
from gausim.io.pixels import decode, read_header

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
# Tags of the EXIF standard.
_ORIENTATION, _FOCAL_35MM = 0x0112, 0xA405
# Orientations that turn the picture by a quarter.
_QUARTER = (5, 6, 7, 8)
# COLMAP's own rule: the longer side of a 35 mm frame.
_FRAME_35MM = 35.0


@dataclass(frozen=True)
class Photo:
    """One photo."""

    name: str  # unique among those of a run; a path with ``/``
    path: Path  # the file
    width: int  # the right way up [pixels]
    height: int  # the right way up [pixels]
    focal: float | None  # by its EXIF data, None where there are none [pixels]


def list_images(folder: Path) -> list[Path]:
    """The image files in a folder, in natural order (2 before 10).

    Raises:
        DataError: there is no such folder, or no image in it.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder. Expected one with photos.")
    found = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    if not found:
        raise DataError(f"{folder}: no images here (looked for {', '.join(SUFFIXES)}).")
    return sorted(found, key=lambda p: natural(p.name))


def open_photo(path: Path, name: str) -> Photo:
    """Size and focal length of a photo, without decoding it.

    Raises:
        DataError: it is missing or no image.
    """
    header = read_header(path)
    if header is None:
        what = "cannot be read as an image" if path.is_file() else "no such file"
        raise DataError(f"{path}: {what}. Export it again.")
    width, height, focal_35mm = header.width, header.height, header.exif.get(_FOCAL_35MM)
    turned = header.exif.get(_ORIENTATION) in _QUARTER
    size = (height, width) if turned else (width, height)
    focal = None
    if isinstance(focal_35mm, int | float) and 0 < focal_35mm < 1e4:
        focal = focal_35mm / _FRAME_35MM * max(size)
    return Photo(name, path, *size, focal)


def read_photo(photo: Photo) -> np.ndarray:
    """(H, W, 3) uint8 BGR the right way up, or (H, W, 4) BGRA where the file has alpha.

    Raises:
        DataError: it cannot be decoded, or is of another size than its header says.
    """
    pixels = decode(photo.path, cv2.IMREAD_COLOR)
    if pixels is None:
        raise DataError(f"{photo.path}: cannot be decoded as an image. Export it again.")
    if photo.path.suffix.lower() in (".png", ".webp", ".tif", ".tiff"):
        raw = decode(photo.path)
        if raw is not None and raw.ndim == 3 and raw.shape[2] == 4 and raw.dtype == np.uint8:
            pixels = raw
    if pixels.shape[:2] != (photo.height, photo.width):
        found = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise DataError(f"{photo.path}: header says {photo.width}x{photo.height}, pixels are {found}. Export it again.")
    return pixels


def write_image(path: Path, pixels: np.ndarray, effort: int = 4) -> None:
    """Writes (H, W), (H, W, 3) BGR or (H, W, 4) BGRA uint8 as PNG or JPEG, all of it or nothing.

    Raises:
        DataError: it cannot be encoded.
    """
    settings = [cv2.IMWRITE_PNG_COMPRESSION, effort] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 90]
    good, data = cv2.imencode(path.suffix, pixels, settings)
    if not good:
        raise DataError(f"{path}: cannot be encoded (shape {pixels.shape}, {pixels.dtype}).")
    write_durably(path, data.tobytes())


def reduced(pixels: np.ndarray, side: int | None) -> np.ndarray:
    """A picture whose longer side is at most ``side`` [pixels]; None leaves it alone."""
    height, width = pixels.shape[:2]
    if not side or max(height, width) <= side:
        return pixels
    scale = side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
