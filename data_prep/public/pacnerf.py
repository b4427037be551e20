"""PAC-NeRF: an object that falls before a known background.

ROOT is data/OBJECT (all_data.json, data/r_CAMERA_FRAME.png). The world is y up, with gravity and a floor at y = 0.
Masks come from a_CAMERA_FRAME.png (RGBA) where they are there; else the object is cut out against frame -1, the empty
scene of each camera, as `segment --backend background` does it. Pixels that frame -2 marks are left out. The authors
have no unseen frames: all are trained on unless --train-frames says otherwise.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from msgspec import Struct

from data_prep.public.cutting import cut_out, read_sized, rgba, size_of, with_alpha
from data_prep.public.fields import inside, lens, numbered, rate_of, read_record, viewmat
from data_prep.public.scene import ImportOptions, Motion, Picture, PublicObject, View, falling
from gausim.core.errors import DataError

DATA = "all_data.json"
_NAME = re.compile(r"r_([0-9]{1,4})_(-?[0-9]{1,6})\.png")
# Frames of the empty scene and of the pixels to ignore, and the alpha above which these are ignored.
PLATE, IGNORED, IGNORED_ALPHA = -1, -2, 50
# Every image repeats its camera, with all digits.
_SAME = 1e-6
# Times of cameras may differ by this fraction of a frame.
_APART = 0.01


@dataclass(frozen=True)
class Options(ImportOptions):
    """Facts that the folder does not contain."""


class _Image(Struct):
    file_path: str
    time: float
    c2w: list
    intrinsic: list


def read(root: Path, options: Options) -> PublicObject:
    """One object.

    Raises:
        DataError: ``all_data.json`` or a picture is missing or malformed, or a camera moves.
    """
    path = root / DATA
    cameras: dict[int, dict[int, tuple[str, Path, _Image]]] = {}
    for i, entry in enumerate(read_record(path, list[_Image])):
        where = f"{path}: [{i}]"
        place = inside(root, entry.file_path.removeprefix("./"), f"{where}: field 'file_path'")
        match = _NAME.fullmatch(place.name)
        frames = cameras.setdefault(int(match[1]), {}) if match else {}
        if match is None or int(match[2]) in frames:
            raise DataError(f"{where}: field 'file_path': expected r_CAMERA_FRAME.png once, got {place.name!r:.80}.")
        frames[int(match[2])] = (where, place, entry)
    views, pictures, times = [], {}, {}
    for camera, frames in sorted(cameras.items()):
        rows = [frames[number] for number in sorted(frames) if number >= 0]
        paths = numbered({n: row[1] for n, row in frames.items() if n >= 0}, f"{path}: camera {camera}")
        views.append(_view(camera, rows))
        pictures[views[-1].name] = _pictures(paths, camera, views[-1].size)
        times[views[-1].name] = [entry.time for _, _, entry in rows]
    if not views:
        raise DataError(f"{path}: expected a list of images, got none.")
    count = min(len(row) for row in pictures.values())
    return PublicObject(
        root, options.name or root.absolute().name, options.fps or _rate(path, times), options.train_frames or count,
        (Motion("seq_000", path, tuple(views), pictures),), options.heldout, falling(1, 1), files={DATA: path},
    )  # fmt: skip


def _view(camera: int, rows: list[tuple[str, Path, _Image]]) -> View:
    """The camera of these images, all of which must repeat it."""
    found = [(viewmat(entry.c2w, f"{where}: field 'c2w'", opengl=True, inverse=True),
              lens(entry.intrinsic, f"{where}: field 'intrinsic'")) for where, _, entry in rows]  # fmt: skip
    for (where, place, _), row in zip(rows, found, strict=True):
        for key, a, b in zip(("c2w", "intrinsic"), row, found[0], strict=True):
            if np.abs(a - b).max() > _SAME * max(1.0, float(np.abs(b).max())):
                raise DataError(
                    f"{where}: field '{key}' of {place.name} differs from that of the first image; expected a camera "
                    f"that stands still. Check camera {camera}."
                )
    (pose, k), (where, first, _) = found[0], rows[0]
    size = size_of(first)
    if np.abs(2 * k[:2, 2] - size).max() > 1:
        raise DataError(
            f"{where}: field 'intrinsic': its middle is that of a picture of {2 * k[0, 2]:g}x{2 * k[1, 2]:g}, "
            f"{first.name} is {size[0]}x{size[1]}. Use the pictures that belong to the cameras."
        )
    return View(f"cam_{camera}", size, k, pose)


def _pictures(paths: tuple[Path, ...], camera: int, size: tuple[int, int]) -> tuple[Picture, ...]:
    """The frames of a camera with the best masks that are there."""
    folder = paths[0].parent
    plate, ignored = (folder / f"r_{camera}_{number}.png" for number in (PLATE, IGNORED))
    beside = (ignored,) if ignored.is_file() else ()
    with_masks = [folder / f"a_{path.name[2:]}" for path in paths]
    if any(p.is_file() for p in with_masks):
        rows: list = [((p,), partial(with_alpha, p, size)) for p in with_masks]
    elif plate.is_file():
        cut = cut_out(paths, plate)
        rows = [((p, plate), partial(cut, i)) for i, p in enumerate(paths)]
    else:
        raise DataError(
            f"{plate}: no such file, and {with_masks[0].name} is not there either. The object is cut out against frame "
            "-1, the empty scene of each camera: restore it."
        )
    return tuple(Picture((*files, *beside), partial(_cleared, take, *beside)) for files, take in rows)


def _cleared(take: Callable[[], np.ndarray], ignored: Path | None = None) -> np.ndarray:
    """The picture, with alpha 0 where that of the picture ``ignored`` is above a threshold."""
    pixels = take()
    if ignored is None:
        return pixels
    marked = read_sized(ignored, (pixels.shape[1], pixels.shape[0]), "the pixels to ignore")[..., 3] > IGNORED_ALPHA
    return rgba(pixels[..., :3], np.where(marked, 0, pixels[..., 3]))


def _rate(path: Path, times: dict[str, list[float]]) -> float:
    """Frames per second by the times of the images [s], which all cameras must share."""
    first, *_ = rates = [rate_of(row, f"{path}: field 'time' of {name}") for name, row in times.items()]
    starts = [row[0] for row in times.values()]
    if max(np.ptp(starts), np.ptp(1 / np.array(rates))) * first > _APART:
        raise DataError(
            f"{path}: field 'time': expected the same times [s] in all cameras, got rates {rates} and starts {starts}. "
            "State --fps."
        )
    return first
