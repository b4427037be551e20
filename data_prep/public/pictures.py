"""Pictures of the public sets as RGBA with straight alpha: colour and mask, colour before white, before a plate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from data_prep.capture.masks.cleanup import Cleanup, cleaned, matte
from data_prep.capture.masks.clips import Clip, read_picture
from data_prep.capture.masks.segmenters import BackgroundSegmenter
from data_prep.common.photos import open_photo
from gausim.core.errors import DataError

# Mask pictures are white on black; brighter than this is the object.
HALF = 127
# A plate's pixel must be so far from white that the share of white in a picture can be told [squared 8-bit values].
_TELLING = 40.0**2


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of a picture [pixels].

    Raises:
        DataError: it is missing or no picture.
    """
    photo = open_photo(path, path.name)
    return photo.width, photo.height


def read_sized(path: Path, size: tuple[int, int], what: str) -> np.ndarray:
    """(H, W, 4) uint8 RGBA of a picture that must have this size.

    Raises:
        DataError: it is missing, no picture, or of another size.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file, expected {what}. Restore it.")
    pixels = read_picture(path)
    if pixels.shape[:2] != (size[1], size[0]):
        found = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise DataError(f"{path}: is {found}, expected {what} of {size[0]}x{size[1]}. Export it again at that size.")
    return pixels


def with_alpha(path: Path, size: tuple[int, int]) -> np.ndarray:
    """A picture that has alpha already.

    Raises:
        DataError: it is no picture of this size, or has no transparent pixel.
    """
    pixels = read_sized(path, size, "a picture")
    if pixels[..., 3].min() == 255:
        raise DataError(f"{path}: has no transparent pixel; expected RGBA whose alpha is the object's mask.")
    return pixels


def masked(path: Path, mask: Path, size: tuple[int, int], ignore: Path | None = None) -> np.ndarray:
    """Colour and the brightness of a mask as alpha; it is 0 where the picture ``ignore`` is bright.

    Raises:
        DataError: a picture is missing, or of another size.
    """
    rgb = read_sized(path, size, "a picture")[..., :3]
    alpha = brightness(read_sized(mask, size, f"the mask of {path.name}"))
    if ignore is not None:
        alpha = np.where(brightness(read_sized(ignore, size, f"the second mask of {path.name}")) > HALF, 0, alpha)
    return straight(rgb, alpha)


def brightness(pixels: np.ndarray) -> np.ndarray:
    """(H, W) uint8 of a mask: its alpha if it has one that says something, else its brightest channel."""
    return np.asarray(pixels[..., 3] if pixels[..., 3].min() < 255 else pixels[..., :3].max(-1))


def straight(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """(H, W, 4) uint8; colour that alpha hides is black, which keeps files small."""
    return np.dstack([np.where(alpha[..., None] > 0, rgb, 0), alpha]).astype(np.uint8)


def before_white(matted: np.ndarray, picture: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """RGBA of an object of which there are (H, W, 3) pictures before white and before a known background.

    With colour F, coverage a and background B the picture is r = a F + (1 − a) B and the matted one
    m = a F + (1 − a) 255. So m − r = (1 − a)(255 − B) gives 1 − a. Where B is nearly white, it tells nothing, and
    whatever is not white in m is the object.
    """
    white = 255.0 - plate.astype(np.float64)
    length = (white**2).sum(-1)
    through = ((matted.astype(np.float64) - picture) * white).sum(-1) / np.maximum(length, 1)
    plain = (matted == 255).all(-1)
    alpha = 1 - np.where(length > _TELLING, through, plain).clip(0, 1)
    # Two roundings to 8 bits: a coverage below this is none.
    alpha[plain | (alpha < 2 / 255)] = 0
    rgb = (matted - (1 - alpha[..., None]) * 255) / np.maximum(alpha, 1 / 255)[..., None]
    return straight(rgb.clip(0, 255).round(), (255 * alpha).round())


def resized(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """RGBA of another size (width, height); colours under alpha 0 do not bleed into the rest."""
    if pixels.shape[:2] == (size[1], size[0]):
        return pixels
    shrinks = size[0] < pixels.shape[1]
    alpha = pixels[..., 3:].astype(np.float32)
    bent = np.concatenate((pixels[..., :3] * (alpha / 255), alpha), -1)
    out = cv2.resize(bent, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    out[..., :3] /= np.maximum(out[..., 3:], 0.5) / 255
    return np.asarray((out.clip(0, 255) + 0.5).astype(np.uint8))


def cut_out(frames: Sequence[Path], plate: Path) -> Callable[[int], np.ndarray]:
    """Cuts a fixed camera's frames out before a plate, as `segment --backend background --plate` does.

    Returns:
        What gives (H, W, 4) uint8 of the frame of a number; it reads at its first call, and raises a
        :class:`DataError` where a picture or the plate is missing or of another size.
    """
    folder = frames[0].parent
    clip = Clip(folder.name, folder, tuple(Path(path.name) for path in frames), moving=True)
    opened = cache(BackgroundSegmenter(plate=plate).open)

    def frame(index: int) -> np.ndarray:
        rgb = clip.rgb(index)
        return matte(rgb, cleaned(opened(clip)(index), rgb, Cleanup(), soft=False))

    return frame
