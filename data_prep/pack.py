"""Packs an object's sequences for streaming: only the foreground's part of each view, as bytes that need no decoding.

Run ``gausim prepare pack ROOT --out STORE``. STORE is a data set of its own, which every command takes; frames are
read from it where they lie, so that training never holds it in memory. ``gausim verify STORE`` checks it.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_prep.common.command import add_result, headline, told
from data_prep.common.progress import Tick, bars, silent
from data_prep.common.stage import Stage, fingerprint, run_stage
from gausim.core import DataError
from gausim.io.files import replacing

if TYPE_CHECKING:
    import numpy as np

    from gausim.data.objects import ObjectData

REVISION = 1
# What an object has besides its sequences; copied as it is.
PARTS = ("dataset.json", "scene.ply", "scene.masks.npz", "scene.json", "rest_points.npz", "rest_mesh.npz", "static")


def pack(root: Path, out: Path, *, margin: int = 2, force: bool = False, tick: Tick = silent) -> dict[str, Any]:
    """Packs one object.

    Args:
        root: its directory.
        out: the store to write, all of it or nothing.
        margin: transparent pixels kept around what the foreground touches.
        force: replace a store of other inputs or settings.
        tick: told of the progress.

    Returns:
        The manifest (see :func:`data_prep.common.stage.run_stage`).

    Raises:
        DataError: a sequence is incomplete, an image unreadable, or ``out`` holds something else.
    """
    from gausim.data.objects import ObjectData

    if margin < 0:
        raise DataError(f"--margin: expected at least 0 pixels, got {margin}.")
    if out.resolve() == root.resolve():
        raise DataError(f"--out {out}: is the object itself. Choose another directory.")
    data = ObjectData(root)
    names = [record.name for record in data.sequences]
    inputs = {str(path.relative_to(root)): path for path in _inputs(root, names)}
    stage = Stage("pack", REVISION, inputs, {"margin": margin}, packages=("numpy", "opencv-python-headless"))
    return run_stage(stage, out, lambda work: _make(data, names, work, margin, tick), force=force)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="gausim prepare pack", description=__doc__.split("\n")[0])
    parser.add_argument("root", type=Path, metavar="ROOT", help="directory of the object (dataset.json, sequences/)")
    parser.add_argument(
        "--margin", type=int, default=2, metavar="PIXELS",
        help="transparent pixels kept around what the foreground touches (default: %(default)s)",
    )  # fmt: skip
    add_result(parser)
    arguments = parser.parse_args(argv)

    def run() -> str:
        with bars() as tick:
            manifest = pack(arguments.root, arguments.out, margin=arguments.margin, force=arguments.force, tick=tick)
        found = manifest["results"]
        return (
            f"{headline(arguments.out, manifest)}: {found['sequences']} sequences, {found['frames']} images in "
            f"{found['packed_bytes'] / 1e6:.1f} MB ({100 * found['share']:.0f} % of whole images)"
        )

    return told(run)


def _inputs(root: Path, names: list[str]) -> Iterator[Path]:
    """Every file that the store depends on."""
    folders = [root / part for part in PARTS] + [root / "sequences" / name for name in names]
    for folder in folders:
        if folder.is_file():
            yield folder
        elif folder.is_dir():
            yield from sorted(path for path in folder.rglob("*") if path.is_file())


def _make(data: ObjectData, names: list[str], work: Path, margin: int, tick: Tick) -> Mapping[str, Any]:
    for part in PARTS:
        _copy(data.root / part, work / part)
    images = packed = whole = 0
    steps = itertools.count(1)
    for name in names:
        made = _sequence(
            data, name, work / "sequences" / name, margin,
            lambda: tick("packing", next(steps), len(names) * len(data.views)),
        )  # fmt: skip
        images, packed, whole = (a + b for a, b in zip((images, packed, whole), made, strict=True))
    files = {str(p.relative_to(work)): fingerprint(p) for p in sorted(work.rglob("*")) if _kept(p)}
    return {
        "sequences": len(names), "frames": images, "packed_bytes": packed, "share": packed / whole, "files": files,
    }  # fmt: skip


def _kept(path: Path) -> bool:
    from data_prep.common.stage import PLAN

    return path.is_file() and path.name != PLAN


def _copy(source: Path, target: Path) -> None:
    if source.is_dir():
        for path in sorted(source.rglob("*")):
            if path.is_file():
                _copy(path, target / path.relative_to(source))
    elif source.is_file() and not target.is_file():
        with replacing(target, typed=True) as temporary:
            shutil.copyfile(source, temporary)


def _sequence(
    data: ObjectData, name: str, folder: Path, margin: int, advance: Callable[[], None]
) -> tuple[int, int, int]:
    """Writes one sequence unless it is there; returns its images and their bytes, packed and whole."""
    from gausim.data.frames import open_frames
    from gausim.io.packed import is_packed, read_packed
    from gausim.io.packed_writer import write_packed

    root = data.root / "sequences" / name
    _copy(root / "ground_truth.npz", folder / "ground_truth.npz")
    source = open_frames(root, data.views, data.fps)
    if not is_packed(folder):
        # A source of its own for each view, so that images of one at most are in memory.
        views = (open_frames(root, data.views, data.fps).read(range(source.count), [i]) for i in range(len(data.views)))
        write_packed(folder, source.cameras, (_told(v[:, 0].numpy(), advance) for v in views), data.fps, margin=margin)
    else:
        for _ in data.views:
            advance()
    images = source.count * len(data.views)
    return images, read_packed(folder).size, 4 * images * source.cameras.width * source.cameras.height


def _told(pixels: np.ndarray, advance: Callable[[], None]) -> np.ndarray:
    advance()
    return pixels


if __name__ == "__main__":
    sys.exit(main())
