"""Writes packed frames, see :mod:`gausim.io.packed`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from gausim.core import Cameras, DataError
from gausim.io.files import replacing, write_durably
from gausim.io.packed import HEADER, PIXELS, SCHEMA, Crop


def write_packed(
    folder: Path, cameras: Cameras, views: Iterable[UInt8[np.ndarray, "F H W 4"]], fps: float, *, margin: int
) -> None:
    """Writes one sequence; ``frames.json``, which makes it one, comes last and whole.

    Args:
        folder: where.
        cameras: one per view.
        views: the straight-alpha RGBA of each, asked for one by one.
        fps: frames per second.
        margin: transparent pixels kept around what the foreground ever touches.

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
    """The smallest box around all pixels with alpha > 0 in any of the frames, and ``margin`` pixels more."""
    touched = np.asarray(np.any(alpha > 0, axis=0))
    if not touched.any():
        return Crop(0, 0, 0, 0, offset)
    rows, columns = np.flatnonzero(touched.any(axis=1)), np.flatnonzero(touched.any(axis=0))
    top, left = max(0, int(rows[0]) - margin), max(0, int(columns[0]) - margin)
    bottom = min(touched.shape[0], int(rows[-1]) + 1 + margin)
    right = min(touched.shape[1], int(columns[-1]) + 1 + margin)
    return Crop(left, top, right - left, bottom - top, offset)


def header(cameras: Cameras, crops: Sequence[Crop], *, count: int, fps: float, size: int, sha256: str) -> bytes:
    """The content of ``frames.json``."""
    views = [
        {
            "name": name,
            "crop": [crop.left, crop.top, crop.width, crop.height],
            "offset": crop.offset,
            "viewmat": cameras.viewmats[i].double().tolist(),
            "K": cameras.Ks[i].double().tolist(),
        }
        for i, (name, crop) in enumerate(zip(cameras.names, crops, strict=True))
    ]
    facts = {"schema": SCHEMA, "frames": count, "width": cameras.width, "height": cameras.height, "fps": fps}
    return json.dumps({**facts, "bytes": size, "sha256": sha256, "views": views}, indent=1).encode() + b"\n"
