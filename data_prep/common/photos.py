"""Photos, masks and frames as all stages read and write them: which there are, their size, focal length and pixels.

Pixels stay as they are stored, as COLMAP reads them: poses and lenses belong to these. Only where a lens was calibrated
for the picture as its EXIF data turn it, the picture is turned (:attr:`Photo.upright`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from gausim.core.errors import DataError
from gausim.io.files import natural, write_durably
from gausim.io.pixels import (
    ORIENTATION,
    QUARTER_TURNS,
    SUFFIXES,
    decode,
    exif_turned,
    is_premultiplied,
    palette_indices,
    read_header,
)

# Pictures that no stage reads.
UNREAD = (".heic", ".heif", ".avif", ".exr", ".hdr", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".gif", ".jp2")
# Tag of the EXIF standard.
_FOCAL_35MM = 0xA405
# COLMAP's own rule: the longer side of a 35 mm frame.
_FRAME_35MM = 35.0
# Values of a mask that JPEG makes of 0 and 255, and the largest value of labels that are no brightness.
_RINGING, _MOST_LABELS = 24, 31


@dataclass(frozen=True)
class Photo:
    """One photo."""

    name: str  # unique among those of a run; a path with ``/``
    path: Path  # the file
    width: int  # [pixels]
    height: int  # [pixels]
    focal: float | None  # by its EXIF data, None where there are none [pixels]
    orientation: int = 1  # by its EXIF data
    upright: bool = False  # whether the picture is turned as the orientation says
    mask: Path | None = None  # a picture of its alpha, of its pixels as stored

    def turned(self) -> Photo:
        """The same photo with pixels as its EXIF data turn it."""
        width, height = (self.height, self.width) if self.orientation in QUARTER_TURNS else (self.width, self.height)
        return replace(self, width=width, height=height, upright=True)

    def read(self) -> np.ndarray:
        """(H, W, 4) uint8 RGBA with straight alpha."""
        pixels = read_picture(self.path)
        if self.mask is not None:
            alpha = read_mask(self.mask, (pixels.shape[1], pixels.shape[0]), self.path.name)
            pixels = np.dstack((pixels[..., :3], np.minimum(alpha, pixels[..., 3])))
        pixels = exif_turned(pixels, self.orientation) if self.upright else pixels
        if pixels.shape[:2] != (self.height, self.width):
            found = f"{pixels.shape[1]}x{pixels.shape[0]}"
            raise DataError(
                f"{self.path}: header says {self.width}x{self.height}, pixels are {found}. Export it again."
            )
        return pixels


def list_images(folder: Path) -> list[Path]:
    """The image files in a folder, in natural order (2 before 10)."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder. Expected one with photos.")
    found = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")]
    if not found:
        raise DataError(f"{folder}: no images here (looked for {', '.join(SUFFIXES)}). {unread_in(folder)}".rstrip())
    return sorted(found, key=lambda p: natural(p.name))


def unread_in(folder: Path) -> str:
    """A sentence about pictures in a folder that no stage reads; empty where there are none."""
    left = sorted(p.suffix for p in folder.iterdir() if p.suffix.lower() in UNREAD and not p.name.startswith("."))
    return f"{folder}: {len(left)} files ({', '.join(dict.fromkeys(left))}) are left out: convert them." if left else ""


def open_photo(path: Path, name: str) -> Photo:
    """Size and focal length of a photo, without decoding it."""
    header = read_header(path)
    if header is None:
        what = "cannot be read as an image" if path.is_file() else "no such file"
        raise DataError(f"{path}: {what}. Export it again.")
    focal_35mm, focal = header.exif.get(_FOCAL_35MM), None
    if isinstance(focal_35mm, int | float) and 0 < focal_35mm < 1e4:
        focal = focal_35mm / _FRAME_35MM * max(header.width, header.height)
    return Photo(name, path, header.width, header.height, focal, header.exif.get(ORIENTATION) or 1)


def read_picture(path: Path) -> np.ndarray:
    """Decodes a picture to (H, W, 4) uint8 RGBA with straight alpha, not turned; opaque where the file has no alpha."""
    pixels = _stored(path)
    if pixels.dtype == np.uint16:
        pixels = np.round(pixels / 257.0).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise DataError(f"{path}: expected 8 or 16 bit per channel, got {pixels.dtype}. Export it again as 8-bit PNG.")
    if pixels.ndim == 2 or pixels.shape[2] == 1:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGBA))
    if pixels.shape[2] == 2:  # grey with alpha
        return np.ascontiguousarray(pixels[..., [0, 0, 0, 1]])
    rgba = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGBA if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA))
    return straight(rgba.astype(np.float32)) if is_premultiplied(rgba) else rgba


def _stored(path: Path) -> np.ndarray:
    """Pixels as stored, in the channels and the type of the file (BGR)."""
    pixels = decode(path)
    if pixels is None:
        what = (
            "cannot be decoded as a picture. Export it again as PNG" if path.is_file() else "no such file. Restore it"
        )
        raise DataError(f"{path}: {what}.")
    return pixels


def read_mask(path: Path, size: tuple[int, int], of: str) -> np.ndarray:
    """(H, W) uint8 alpha of a mask picture, whatever it is encoded as.

    Alpha, where there is some; else brightness of 0 to 255, 0 and 1, one bit; of a palette everything but number 0.

    Args:
        path: the file.
        size: width and height that it must have [pixels].
        of: what it is the mask of, for messages.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file, expected the mask of {of}. Restore it.")
    pixels, labels = read_picture(path), palette_indices(path)
    has_alpha = bool(pixels[..., 3].min() < 255)
    alpha = pixels[..., 3] if has_alpha else pixels[..., :3].max(-1)
    if labels is not None and (pixels[..., :3] != pixels[..., :1]).any():
        alpha = np.where(labels > 0, 255, 0).astype(np.uint8)
    elif alpha.max() <= 1:  # a 1 of 16 bit is rounded away
        stored = _stored(path)
        values = stored if stored.ndim == 2 else stored[..., 3] if has_alpha else stored[..., :3].max(-1)
        alpha = (255 * np.minimum(values, 1)).astype(np.uint8)
    if alpha.shape != (size[1], size[0]):
        raise DataError(
            f"{path}: is {alpha.shape[1]}x{alpha.shape[0]}, expected the mask of {of}, {size[0]}x{size[1]}. Export it "
            "again at that size."
        )
    most = int(alpha.max())
    if 0 < most < 128:
        what = "labels of several things" if most <= _MOST_LABELS else "half transparent everywhere"
        raise DataError(f"{path}: its largest value is {most} ({what}); expected a mask of 0 and 255. Export it again.")
    if path.suffix.lower() in (".jpg", ".jpeg"):
        alpha = np.where(alpha < _RINGING, 0, np.where(alpha > 255 - _RINGING, 255, alpha)).astype(np.uint8)
    return np.ascontiguousarray(alpha)


def find_mask(folder: Path, name: Path) -> Path:
    """The mask of a picture by its name in a folder of masks: with the ending .png, its own, or both."""
    place = folder / name
    for candidate in (place.with_suffix(".png"), place, place.with_name(f"{place.name}.png")):
        if candidate.is_file():
            return candidate
    raise DataError(f"{place.with_suffix('.png')}: no mask of {name}. Name the masks like the pictures.")


def write_picture(path: Path, pixels: np.ndarray, effort: int = 1) -> None:
    """Writes (H, W), (H, W, 3) RGB or (H, W, 4) RGBA uint8 as PNG (or JPEG by its name), whole or not at all."""
    settings = [cv2.IMWRITE_PNG_COMPRESSION, effort] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 90]
    code = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}.get(pixels.shape[2] if pixels.ndim == 3 else 1)
    good, data = cv2.imencode(path.suffix, pixels if code is None else cv2.cvtColor(pixels, code), settings)
    if not good:
        raise DataError(f"{path}: cannot be encoded (shape {pixels.shape}, {pixels.dtype}).")
    write_durably(path, data.tobytes())


def reduced(pixels: np.ndarray, side: int | None) -> np.ndarray:
    """A picture whose longer side is at most ``side`` [pixels]; None leaves it alone."""
    height, width = pixels.shape[:2]
    if not side or max(height, width) <= side:
        return pixels
    scale = side / max(height, width)
    return resized(pixels, (max(1, round(width * scale)), max(1, round(height * scale))))


def resized(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture of another size (width, height); colours under alpha 0 do not bleed into the rest."""
    if pixels.shape[:2] == (size[1], size[0]):
        return pixels
    how = cv2.INTER_AREA if size[0] < pixels.shape[1] else cv2.INTER_LINEAR
    if pixels.ndim == 2 or pixels.shape[2] == 3:
        return cv2.resize(pixels, size, interpolation=how)
    return straight(cv2.resize(premultiplied(pixels), size, interpolation=how))


def premultiplied(pixels: np.ndarray) -> np.ndarray:
    """(H, W, 4) uint8 RGBA as float32 with colours times alpha."""
    alpha = pixels[..., 3:].astype(np.float32)
    return np.concatenate((pixels[..., :3] * (alpha / 255), alpha), -1)


def straight(values: np.ndarray) -> np.ndarray:
    """The inverse of :func:`premultiplied`, rounded."""
    values[..., :3] /= np.maximum(values[..., 3:], 0.5) / 255
    return np.asarray((values.clip(0, 255) + 0.5).astype(np.uint8))


def check_one_size(photos: list[Photo] | tuple[Photo, ...]) -> None:
    """Raises :class:`DataError` naming a photo whose size is not that of the first."""
    for photo in photos:
        if (photo.width, photo.height) != (photos[0].width, photos[0].height):
            raise DataError(
                f"{photo.path}: is {photo.width}x{photo.height}, {photos[0].path.name} is "
                f"{photos[0].width}x{photos[0].height}; use photos of one size, all upright or all lengthwise."
            )
