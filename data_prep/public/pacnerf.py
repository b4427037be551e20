"""PAC-NeRF: an object that falls.

ROOT is data/OBJECT (all_data.json, data/r_CAMERA_FRAME.png). The world is y up, with gravity and a floor at y = 0.
Pictures with alpha, a_CAMERA_FRAME.png, are taken where they are there; else the result is to be segmented next, by
`segment --backend background` with frame -1, the empty scene of each camera, as --plate. The authors have no unseen
frames: all are trained on unless --train-frames says otherwise.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from msgspec import Struct

from data_prep.common.photos import read_picture
from data_prep.public.fields import inside, lens, numbered, rate_of, read_record, size_of, viewmat
from data_prep.public.scene import ImportOptions, Motion, Picture, PublicObject, View, falling
from gausim.core.errors import DataError

Options, DATA = ImportOptions, "all_data.json"
_NAME = re.compile(r"r_([0-9]{1,4})_(-?[0-9]{1,6})\.png")
# Every image repeats its camera, with all digits.
_SAME = 1e-6
# Times of cameras may differ by this [s].
_APART = 1e-4


class _Image(Struct):
    file_path: str
    time: float
    c2w: list
    intrinsic: list


def read(root: Path, options: ImportOptions) -> PublicObject:
    """One object."""
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
    views, pictures, times = [], {}, []
    for camera, frames in sorted(cameras.items()):
        paths = numbered({n: row[1] for n, row in frames.items() if n >= 0}, f"{path}: camera {camera}")
        rows = [frames[number] for number in range(len(paths))]
        views.append(_view(camera, rows))
        cut = [p.with_name(f"a_{p.name[2:]}") for p in paths]
        chosen = cut if cut[0].is_file() else paths
        pictures[views[-1].name] = tuple(Picture((p,), partial(read_picture, p)) for p in chosen)
        times.append([entry.time for _, _, entry in rows])
    if not views or any(np.abs(np.subtract(a, b)).max() > _APART for a in times for b in times if len(a) == len(b)):
        raise DataError(f"{path}: expected images of some cameras, all with the same times [s].")
    count = min(map(len, times))
    return PublicObject(
        root, options.name or root.absolute().name, options.fps or rate_of(times[0], f"{path}: field 'time'"),
        options.train_frames or count, (Motion("seq_000", path, tuple(views), pictures),), options.heldout,
        falling(1, 1), files={DATA: path},
    )  # fmt: skip


def _view(camera: int, rows: list[tuple[str, Path, _Image]]) -> View:
    """The camera of these images, all of which must repeat it."""
    found = [(viewmat(entry.c2w, f"{where}: field 'c2w'", opengl=True, inverse=True),
              lens(entry.intrinsic, f"{where}: field 'intrinsic'")) for where, _, entry in rows]  # fmt: skip
    for (where, place, _), row in zip(rows, found, strict=True):
        if any(np.abs(a - b).max() > _SAME * max(1.0, np.abs(b).max()) for a, b in zip(row, found[0], strict=True)):
            raise DataError(
                f"{where}: fields 'c2w', 'intrinsic' of {place.name} differ from those of the first image; expected a "
                f"camera that stands still. Check camera {camera}."
            )
    (pose, k), (where, first, _), size = found[0], rows[0], size_of(rows[0][1])
    if np.abs(2 * k[:2, 2] - size).max() > 1:
        raise DataError(
            f"{where}: field 'intrinsic': its middle is that of a picture of {2 * k[0, 2]:g}x{2 * k[1, 2]:g}, "
            f"{first.name} is {size[0]}x{size[1]}. Use the pictures that belong to the cameras."
        )
    return View(f"cam_{camera}", size, k, pose)
