"""Brings an object of PAC-NeRF's data to our layout.

ROOT is data/OBJECT (all_data.json, data/r_CAMERA_FRAME.png). The world is y up, with gravity and a floor at y = 0.
Masks come from a_CAMERA_FRAME.png (RGBA) where they are there; else from m_CAMERA_FRAME.png (before white) and the
empty scene, frame -1 of each camera; else the object is cut out against frame -1 as `segment --backend background` does
it. Pixels that frame -2 marks are left out. There are no stills: frame 0 of the cameras takes their place. The authors
have no unseen frames: all are trained on unless --train-frames says otherwise.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from data_prep.public.fields import field, inside, lens, numbered, rate_of, read_list, viewmat
from data_prep.public.importing import Importer, ImportOptions, rate_option
from data_prep.public.pictures import before_white, cut_out, read_sized, size_of, straight, with_alpha
from data_prep.public.scene import GRAVITY, Motion, Picture, PublicObject, View, floor
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
class PacNerfOptions(ImportOptions):
    """Facts that the folder does not contain."""

    fps: float | None = rate_option("by the times of all_data.json")


@dataclass(frozen=True, eq=False)
class _Image:
    """One entry of ``all_data.json``."""

    where: str  # file and field
    path: Path
    time: float
    viewmat: np.ndarray
    k: np.ndarray


def read_pacnerf(root: Path, options: PacNerfOptions) -> PublicObject:
    """One object.

    Raises:
        DataError: ``all_data.json`` or a picture is missing or malformed, or a camera moves.
    """
    path = root / DATA
    views, pictures, times = [], {}, {}
    for camera, frames in sorted(_images(root, path).items()):
        rows = [frames[number] for number in sorted(frames) if number >= 0]
        paths = numbered({n: image.path for n, image in frames.items() if n >= 0}, f"{path}: camera {camera}")
        view = _view(camera, rows)
        views.append(view)
        pictures[view.name] = _pictures(paths, camera, view.size)
        times[view.name] = [row.time for row in rows]
    count = min(len(row) for row in pictures.values())
    return PublicObject(
        root, options.name or root.absolute().name, options.fps or _rate(path, times), options.train_frames or count,
        (Motion("seq_000", path, tuple(views), pictures),), options.heldout,
        {"gravity": [0.0, -GRAVITY, 0.0], "floor": floor((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), "free": True},
        files={DATA: path},
    )  # fmt: skip


def _images(root: Path, path: Path) -> dict[int, dict[int, _Image]]:
    """The images by camera and frame."""
    images: dict[int, dict[int, _Image]] = {}
    for i, entry in enumerate(read_list(path, "images")):
        where = f"{path}: [{i}]"
        name = field(entry, "file_path", str, where)
        place = inside(root, name.removeprefix("./"), f"{where}: field 'file_path'")
        match = _NAME.fullmatch(place.name)
        if match is None:
            raise DataError(f"{where}: field 'file_path' must end in r_CAMERA_FRAME.png, got {name!r:.80}.")
        pose = viewmat(field(entry, "c2w", list, where), f"{where}: field 'c2w'", opengl=True, inverse=True)
        k = lens(field(entry, "intrinsic", list, where), f"{where}: field 'intrinsic'")
        time = field(entry, "time", float, where)
        frames, number = images.setdefault(int(match[1]), {}), int(match[2])
        if number in frames:
            raise DataError(f"{where}: field 'file_path' '{place.name}' stands twice.")
        frames[number] = _Image(where, place, time, pose, k)
    return images


def _view(camera: int, rows: list[_Image]) -> View:
    """The camera of these images, all of which must repeat it."""
    first = rows[0]
    for row in rows[1:]:
        for key, a, b in (("c2w", row.viewmat, first.viewmat), ("intrinsic", row.k, first.k)):
            if np.abs(a - b).max() > _SAME * max(1.0, float(np.abs(b).max())):
                raise DataError(
                    f"{row.where}: field '{key}' differs from that of {first.path.name}; expected a camera that stands "
                    f"still. Check camera {camera}."
                )
    size = size_of(first.path)
    expected = 2 * first.k[0, 2], 2 * first.k[1, 2]
    if np.abs(np.array(expected) - size).max() > 1:
        raise DataError(
            f"{first.where}: field 'intrinsic': its middle is that of a picture of {expected[0]:g}x{expected[1]:g}, "
            f"{first.path.name} is {size[0]}x{size[1]}. Use the pictures that belong to the cameras."
        )
    return View(f"cam_{camera}", size, first.k, first.viewmat)


def _pictures(paths: tuple[Path, ...], camera: int, size: tuple[int, int]) -> tuple[Picture, ...]:
    """The frames of a camera with the best masks that are there."""
    folder = paths[0].parent
    plate, ignored = (folder / f"r_{camera}_{number}.png" for number in (PLATE, IGNORED))
    beside = (ignored,) if ignored.is_file() else ()
    rgba, matted = ([folder / f"{kind}_{path.name[2:]}" for path in paths] for kind in "am")
    if any(p.is_file() for p in rgba):
        rows: list[tuple[tuple[Path, ...], Callable[[], np.ndarray]]] = [
            ((p,), partial(with_alpha, p, size)) for p in rgba
        ]
    elif not plate.is_file():
        raise DataError(
            f"{plate}: no such file, and {rgba[0].name} is not there either. The object is cut out against frame -1, "
            "the empty scene of each camera: restore it."
        )
    elif any(p.is_file() for p in matted):
        rows = [((m, p, plate), partial(_unmatted, m, p, plate, size)) for m, p in zip(matted, paths, strict=True)]
    else:
        cut = cut_out(paths, plate)
        rows = [((p, plate), partial(cut, i)) for i, p in enumerate(paths)]
    return tuple(Picture((*files, *beside), partial(_cleared, read, *beside)) for files, read in rows)


def _unmatted(matted: Path, picture: Path, plate: Path, size: tuple[int, int]) -> np.ndarray:
    whats = ((matted, f"{picture.name} before white"), (picture, "a picture"), (plate, "the empty scene"))
    return before_white(*(read_sized(path, size, what)[..., :3] for path, what in whats))


def _cleared(read: Callable[[], np.ndarray], ignored: Path | None = None) -> np.ndarray:
    """The picture, with alpha 0 where that of the picture ``ignored`` is above a threshold."""
    pixels = read()
    if ignored is None:
        return pixels
    marked = read_sized(ignored, (pixels.shape[1], pixels.shape[0]), "the pixels to ignore")[..., 3] > IGNORED_ALPHA
    return straight(pixels[..., :3], np.where(marked, 0, pixels[..., 3]))


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


# The number rises when the same inputs and settings give another result than before.
import_pacnerf = Importer(
    "import_pacnerf", 1, PacNerfOptions, lambda root, options: [read_pacnerf(root, options)],
    "data/OBJECT, with all_data.json and data/", __doc__,
)  # fmt: skip
main = import_pacnerf.main
