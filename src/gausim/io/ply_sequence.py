"""A motion as numbered PLY files, name_0001.ply, name_0002.ply, ..., the format of SuperSplat's timeline."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from gausim.core import DataError, GaussianScene, SceneError
from gausim.io.files import write_json
from gausim.io.plain_json import read_json
from gausim.io.ply import load_scene, save_masks, save_scene
from gausim.io.transforms import positive_field

# SuperSplat orders files by the number at the end of their names.
_NAME = re.compile(r"(?P<stem>.+)_(?P<number>\d{4,6})\.ply")


def save_ply_sequence(folder: Path | str, name: str, frames: Iterable[GaussianScene], fps: float) -> list[Path]:
    """Writes one PLY per frame, NAME_0001.ply first, with NAME.masks.npz (of the first) and NAME.json (fps) beside.

    Raises:
        DataError: files of this name exist already, or there are no frames to write.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    there = [path.name for _, stem, path in _numbered(folder) if stem == name]
    if there:
        raise DataError(f"{folder}: holds '{there[0]}' already. Choose another folder or name, or delete its frames.")
    written = []
    for number, scene in enumerate(frames, start=1):
        if number == 1:
            save_masks(scene, folder / f"{name}.masks.npz")
        written.append(folder / f"{name}_{number:04d}.ply")
        save_scene(scene, written[-1], masks=False)
    if not written:
        raise DataError(f"{folder}: no frames to write; a sequence needs at least one.")
    write_json(folder / f"{name}.json", {"fps": fps, "frames": len(written)})
    return written


def load_ply_sequence(folder: Path | str, *, fps: float | None = None) -> tuple[Iterator[GaussianScene], int, float]:
    """Scenes of numbered PLY files, read on request, their number, and frames per second (``fps`` or NAME.json).

    Raises:
        DataError: there are no such files or files of several sequences, a number is missing, or the frame rate is
            unknown or wrong.
        SceneError: (while reading) a file is unusable, or has another number of Gaussians than the first.
    """
    folder = Path(folder)
    found = _numbered(folder)
    stems = sorted({stem for _, stem, _ in found})
    if len(stems) != 1:
        raise DataError(f"{folder}: expected files NAME_0001.ply, NAME_0002.ply, ... of one sequence, got {stems[:5]}.")
    numbers = [number for number, _, _ in found]
    wrong = next(
        (n for n, expected in zip(numbers, range(numbers[0], numbers[-1] + 1), strict=False) if n != expected), None
    )
    if wrong is not None:
        raise DataError(f"{folder}: a number before {wrong} is missing, or stands there twice. Complete the sequence.")
    path = folder / f"{stems[0]}.json"
    if fps is None and not path.is_file():
        raise DataError(f"{path}: no such file, so the frame rate is unknown. State it (--fps).")
    rate = positive_field(read_json(path) if fps is None else {"fps": fps}, "fps", str(path))
    return _scenes([path for *_, path in found], folder / f"{stems[0]}.masks.npz"), len(found), rate


def _scenes(paths: list[Path], masks: Path) -> Iterator[GaussianScene]:
    count = None
    for path in paths:
        scene = load_scene(path, masks=masks if masks.is_file() else None)
        count = scene.count if count is None else count
        if scene.count != count:
            raise SceneError(f"{path}: expected {count} Gaussians as in '{paths[0].name}', got {scene.count}.")
        yield scene


def _numbered(folder: Path) -> list[tuple[int, str, Path]]:
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder. Expected one with NAME_0001.ply, NAME_0002.ply, ...")
    matches = [(match, path) for path in folder.iterdir() if (match := _NAME.fullmatch(path.name))]
    return sorted((int(match["number"]), match["stem"], path) for match, path in matches)
