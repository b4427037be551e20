"""Decoding of image files by OpenCV, after checks of declared sizes, which a damaged file may exaggerate."""

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

# Endings of the pictures that all stages read, in small letters.
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
# Tags of the EXIF standard: its sub-directory, and how the picture is to be turned; a quarter by these.
_EXIF, ORIENTATION = 0x8769, 0x0112
QUARTER_TURNS = (5, 6, 7, 8)
# Turns that undo another; every other one undoes itself.
_INVERSE = {6: 8, 8: 6}
# Number of pixels that show whether colours are multiplied by alpha.
_EVIDENCE = 16


def decode(path: Path) -> np.ndarray | None:
    """Pixels of an image as stored, BGR or BGRA or grey, rows first; None where it cannot be decoded.

    Checksums come first, where the format has them: OpenCV makes room for whatever length a damaged part states.
    """
    if not _opened(path, _is_whole):
        return None
    tiff = _opened(path, _tiff)
    if tiff is not None:
        return tiff
    try:
        return cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except (cv2.error, MemoryError):
        return None


def _tiff(image: "Image") -> np.ndarray | None:
    """Pixels of a TIFF as stored; None for other files.

    OpenCV multiplies the colours of a TIFF by its alpha, and cannot read one that is to be turned.
    """
    if image.format != "TIFF":
        return None
    orientation = image.getexif().get(ORIENTATION) or 1
    image.load()  # which turns it
    kept = image.mode in ("L", "RGB", "RGBA") or image.mode.startswith(("I", "F"))
    mode = {"1": "L", "LA": "RGBA", "PA": "RGBA", "RGBa": "RGBA"}.get(image.mode, "RGB")
    stored = exif_turned(np.asarray(image if kept else image.convert(mode)), _INVERSE.get(orientation, orientation))
    return stored if stored.ndim == 2 else np.ascontiguousarray(stored[..., [2, 1, 0, 3][: stored.shape[2]]])


def is_premultiplied(rgba: np.ndarray) -> bool:
    """Whether the colours of an (H, W, 4) uint8 picture are multiplied by its alpha, by its half transparent pixels.

    Then no colour is above alpha. Evidence are pixels whose alpha is below what opaque pixels have for a colour: those
    of a picture with straight alpha would be above it.
    """
    brightest, alpha = rgba[..., :3].max(-1), rgba[..., 3]
    opaque = brightest[alpha > 250]
    if not opaque.size or brightest[alpha == 0].any():
        return False
    evidence = (alpha > 0) & (alpha < 0.75 * np.quantile(opaque, 0.1))
    return bool(evidence.sum() >= _EVIDENCE and (brightest[evidence] <= alpha[evidence] + 1.0).all())


def palette_indices(path: Path) -> np.ndarray | None:
    """(H, W) numbers of the colours of a picture that has a palette without transparency; None for other pictures."""
    return _opened(path, lambda image: np.asarray(image) if _has_palette(image) else None)


def exif_turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """A stored picture (H, W, C) as its EXIF orientation turns it."""
    turns: dict[int, Callable[[np.ndarray], np.ndarray]] = {
        2: lambda p: p[:, ::-1], 3: lambda p: p[::-1, ::-1], 4: lambda p: p[::-1], 5: lambda p: p.swapaxes(0, 1),
        6: lambda p: np.rot90(p, -1), 7: lambda p: p[::-1, ::-1].swapaxes(0, 1), 8: np.rot90,
    }  # fmt: skip
    return np.ascontiguousarray(turns[orientation](pixels)) if orientation in turns else pixels


def _has_palette(image: "Image") -> bool:
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


def _opened(path: Path, read: "Callable[[Image], T]") -> T | None:
    """What is read from an image that Pillow has opened but not decoded; None where it raises anything."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # By a path Pillow maps uncompressed files into memory, and gets those wrong that are to be turned.
            with path.open("rb") as file, Image.open(file) as image:
                return read(image)
    except Exception:  # Pillow's readers raise many kinds of exceptions on damaged files
        return None


def _header(image: "Image") -> ImageHeader:
    tags = image.getexif()
    # Pillow tells the size of a TIFF after the turn.
    swapped = image.format == "TIFF" and tags.get(ORIENTATION) in QUARTER_TURNS
    width, height = (image.height, image.width) if swapped else (image.width, image.height)
    return ImageHeader(width, height, image.mode, {**tags, **tags.get_ifd(_EXIF)})


def _is_whole(image: "Image") -> bool:
    image.verify()  # raises otherwise
    return True
