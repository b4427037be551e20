"""Decoding and checking of RGBA image files, and compositing of straight alpha."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gausim.core import Cameras, DataError
from gausim.io.pixels import decode, read_header

# Decoding releases the interpreter lock; more threads than this only wait for the disk.
DECODER_THREADS = 4


def composite(
    frames: UInt8[Tensor, "*B H W 4"], background: Float[Tensor, " 3"] | None = None
) -> tuple[Float[Tensor, "*B H W 3"], Float[Tensor, "*B H W"]]:
    """RGB and alpha in [0, 1] of straight-alpha RGBA over a background in [0, 1] (None: black), in sRGB.

    The foreground mask is alpha > 0.
    """
    values = frames.float() / 255
    rgb, alpha = values[..., :3] * values[..., 3:], values[..., 3]
    if background is not None:
        rgb = rgb + (1 - alpha[..., None]) * background.to(rgb)
    return rgb, alpha


def read_rgba(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Decodes one 8-bit RGBA image of ``size`` = (width, height) to (H, W, 4).

    Raises:
        DataError: the file is missing, is not an image, or has another size or depth or no alpha.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such image, though its transforms.json names it. Restore or re-export it.")
    header = read_header(path)
    if header is not None and (header.width, header.height) != size:
        raise DataError(
            f"{path}: expected {size[0]}x{size[1]} RGBA (8 bit), got {header.width}x{header.height} {header.mode}. "
            "Re-export the frame at the size of its camera."
        )
    pixels = decode(path)
    if pixels is None:
        raise DataError(f"{path}: cannot be decoded as an image{_film_hint(path)}. Re-export the frame as PNG.")
    expected = (size[1], size[0], 4)
    if pixels.shape != expected or pixels.dtype != np.uint8:
        channels = {2: "gray"}.get(pixels.ndim) or {3: "RGB", 4: "RGBA"}.get(pixels.shape[-1], "?")
        found = f"{pixels.shape[1]}x{pixels.shape[0]} {channels} ({pixels.dtype.itemsize * 8} bit)"
        remedy = "with alpha (the foreground mask)" if channels != "RGBA" else "as 8-bit RGBA of the camera's size"
        raise DataError(
            f"{path}: expected {size[0]}x{size[1]} RGBA (8 bit), got {found}. Re-export the frame {remedy}."
        )
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA)


def _film_hint(path: Path) -> str:
    """Advice where the file is a film or a phone's photo (HEVC, MP4, MOV, HEIC), by its first bytes."""
    with path.open("rb") as stream:
        is_container = stream.read(12)[4:8] == b"ftyp"
    if not is_container:
        return ""
    return (
        ": it is a film or a photo in a film's container (MP4, MOV, HEIC). Frames are PNG files with alpha; "
        "`gausim prepare ingest` makes them of films, `gausim prepare segment` cuts the object out"
    )


def room_for(count: tuple[int, ...], cameras: Cameras, where: Path) -> UInt8[np.ndarray, "*count H W 4"]:
    """Unfilled RGBA images of these cameras; they take no physical memory before they are decoded into.

    Raises:
        DataError: there is no memory for so many of this size, which ``where`` states.
    """
    try:
        return np.empty((*count, cameras.height, cameras.width, 4), np.uint8)
    except (ValueError, MemoryError) as error:
        raise DataError(
            f"{where}: {math.prod(count)} images of {cameras.width}x{cameras.height} do not fit into memory. "
            "Check its fields 'w' and 'h', or export smaller images."
        ) from error


def read_rgba_into(paths: Sequence[Path], targets: Sequence[np.ndarray], size: tuple[int, int]) -> None:
    """Decodes each path into the (H, W, 4) array of the same index, in parallel (see :func:`read_rgba`)."""

    def decode(item: tuple[Path, np.ndarray]) -> None:
        item[1][...] = read_rgba(item[0], size)

    with ThreadPoolExecutor(DECODER_THREADS) as pool:
        for _ in pool.map(decode, zip(paths, targets, strict=True)):
            pass


def write_rgba(path: Path, pixels: UInt8[Tensor, "H W 4"] | np.ndarray) -> None:
    """Writes 8-bit straight-alpha RGBA as PNG."""
    array = np.ascontiguousarray(np.asarray(torch.as_tensor(pixels)))
    if not cv2.imwrite(str(path), cv2.cvtColor(array, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_PNG_COMPRESSION, 4]):
        raise DataError(f"{path}: cannot be written. Check the folder and the free space.")
