"""Pictures of the public sets with their masks as alpha."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from data_prep.capture.masks.cleanup import Cleanup, cleaned, matte
from data_prep.capture.masks.clips import Clip
from data_prep.capture.masks.segmenters import BackgroundSegmenter
from data_prep.common.photos import open_photo, read_mask, read_picture
from gausim.core.errors import DataError


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
    """Colour with a mask as alpha, which is 0 where the mask ``ignore`` shows something.

    Raises:
        DataError: a picture is missing, or of another size.
    """
    rgb, alpha = read_sized(path, size, "a picture")[..., :3], read_mask(mask, size, path.name)
    if ignore is not None:
        alpha = np.where(read_mask(ignore, size, path.name) > 127, 0, alpha)
    return rgba(rgb, alpha)


def rgba(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """(H, W, 4) uint8; colour that alpha hides is black, which keeps files small."""
    return np.dstack([np.where(alpha[..., None] > 0, rgb, 0), alpha]).astype(np.uint8)


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
