"""Spring-Gaus: a synthetic fall.

ROOT is data/mpm_synthetic/render/OBJECT (camera.json, camera_0/000.png ...). The world is y up, with gravity and a
floor at y = 0.3; frames 0 to 19 are trained on.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from msgspec import Struct

from data_prep.common.photos import list_images, read_picture
from data_prep.public.fields import check_name, lens, numbered, rate_of, read_record, size_of, viewmat
from data_prep.public.scene import ImportOptions, Motion, Picture, PublicObject, View, falling
from gausim.core.errors import DataError

Options, CAMERAS = ImportOptions, "camera.json"
# Their renderer's world: frames every 0.03 s, a floor at this height, the first 20 of 30 frames seen.
FPS, FLOOR, SEEN = 1 / 0.03, 0.3, 20


class _Camera(Struct):
    camera: str
    K: list
    c2w: list


def read(root: Path, options: ImportOptions) -> PublicObject:
    """One synthetic object."""
    path, views, pictures = root / CAMERAS, [], {}
    for i, entry in enumerate(read_record(path, list[_Camera])):
        where = f"{path}: [{i}]: field"
        name = check_name(entry.camera, f"{where} 'camera'")
        frames = _frames(root / name)
        size = size_of(frames[0])
        pose = viewmat(entry.c2w, f"{where} 'c2w'", opengl=True, inverse=True)
        views.append(View(name, size, lens(entry.K, f"{where} 'K'"), pose))
        pictures[name] = tuple(Picture((p,), partial(read_picture, p)) for p in frames)
    if not views or len(pictures) < len(views):
        raise DataError(f"{path}: expected cameras with names of their own, got {[view.name for view in views]}.")
    count, times = min(len(row) for row in pictures.values()), root / "frame.json"
    return PublicObject(
        root, options.name or root.absolute().name,
        options.fps or (_rate(times, count) if times.is_file() else FPS), options.train_frames or min(SEEN, count),
        (Motion("seq_000", root, tuple(views), pictures),), options.heldout, falling(1, 1, FLOOR),
        files={name: root / name for name in (CAMERAS, times.name) if (root / name).is_file()},
    )  # fmt: skip


def _frames(folder: Path) -> tuple[Path, ...]:
    """The frames 000.png, 001.png … of a folder."""
    paths: dict[int, Path] = {}
    for path in list_images(folder):
        if not path.stem.isdecimal() or not path.stem.isascii() or len(path.stem) > 9 or int(path.stem) in paths:
            raise DataError(f"{path}: expected frames 000.png, 001.png … once each. Take this file out of the folder.")
        paths[int(path.stem)] = path
    return numbered(paths, str(folder))


def _rate(path: Path, count: int) -> float:
    """Frames per second by the times of ``frame.json``: a list of objects whose first value is the time [s]."""
    entries = read_record(path, list[dict[str, float]])
    if len(entries) != count or not all(entries):
        raise DataError(
            f"{path}: has times of {len(entries)} frames, the folders have {count}. Restore what is missing."
        )
    return rate_of([next(iter(entry.values())) for entry in entries], str(path))
