"""A motion as numbered PLY files, name_0001.ply, name_0002.ply, ..., the format of SuperSplat's timeline."""

import re
from collections.abc import Iterable
from pathlib import Path

from gausim.core import DataError, GaussianScene
from gausim.io.files import write_json
from gausim.io.ply import save_masks, save_scene


def save_ply_sequence(folder: Path | str, name: str, frames: Iterable[GaussianScene], fps: float) -> list[Path]:
    """Writes one PLY per frame, NAME_0001.ply first, with NAME.masks.npz (of the first) and NAME.json (fps) beside.

    Raises:
        DataError: files of this name exist already, or there are no frames to write.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    # SuperSplat orders files by the number at the end of their names.
    there = sorted(
        path.name for path in folder.iterdir() if re.fullmatch(rf"{re.escape(name)}_\d{{4,6}}\.ply", path.name)
    )
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
