"""Pack an object's sequences for streaming: only the foreground's part of each view, as bytes that need no decoding.

STORE, the result, is a data set of its own, which every command takes; frames are
read from it where they lie, so that training never holds it in memory. ``gausim verify STORE`` checks it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_prep.common.command import headline, run_command, stage_parser
from data_prep.common.progress import Tick, silent
from data_prep.common.stage import Stage, copy_missing, files_in, run_stage
from gausim.core import DataError

if TYPE_CHECKING:
    from gausim.data.objects import ObjectData

REVISION = 2
# Files of an object besides its sequences; copied unchanged.
PARTS = ("dataset.json", "scene.ply", "scene.masks.npz", "scene.json", "rest_points.npz", "rest_mesh.npz", "static")


def pack(root: Path, out: Path, *, margin: int = 2, overwrite: bool = False, tick: Tick = silent) -> dict[str, Any]:
    """Packs one object."""
    from gausim.data.objects import ObjectData

    if margin < 0:
        raise DataError(f"--margin: expected at least 0 pixels, got {margin}.")
    if out.resolve() == root.resolve():
        raise DataError(f"--out {out}: is the object itself. Choose another directory.")
    data = ObjectData(root)
    names = [record.name for record in data.sequences]
    inputs = {str(path.relative_to(root)): path for path in _inputs(root, names)}
    stage = Stage("pack", REVISION, inputs, {"margin": margin}, packages=("numpy", "opencv-python-headless"))
    return run_stage(stage, out, lambda work: _make(data, names, work, margin, tick), overwrite=overwrite)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("pack", __doc__)
    parser.add_argument("root", type=Path, metavar="ROOT", help="directory of the object (dataset.json, sequences/)")
    parser.add_argument(
        "--margin", type=int, default=2, metavar="PIXELS",
        help="keep so many transparent pixels around what the foreground touches (default: %(default)s)",
    )  # fmt: skip

    def run(given: argparse.Namespace, tick: Tick) -> str:
        manifest = pack(given.root, given.out, margin=given.margin, overwrite=given.overwrite, tick=tick)
        found = manifest["results"]
        return (
            f"{headline(given.out, manifest)}: {found['sequences']} sequences, {found['frames']} images in "
            f"{found['packed_bytes'] / 1e6:.1f} MB ({100 * found['share']:.0f} % of whole images)"
        )

    return run_command(parser, argv, run)


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
        copy_missing(data.root / part, work / part)
    images = packed = whole = 0
    for number, name in enumerate(names, 1):
        made = _sequence(data, name, work / "sequences" / name, margin)
        images, packed, whole = (a + b for a, b in zip((images, packed, whole), made, strict=True))
        tick("packing", number, len(names))
    sizes = {"packed_bytes": packed, "share": packed / whole}
    return {"sequences": len(names), "frames": images, **sizes, "files": files_in(work)}


def _sequence(data: ObjectData, name: str, folder: Path, margin: int) -> tuple[int, int, int]:
    """Writes one sequence unless it is there; returns its images and their bytes, packed and whole."""
    from gausim.data.frames import open_frames
    from gausim.io.packed import is_packed, read_packed, write_packed

    root = data.root / "sequences" / name
    for own in ("ground_truth.npz", "hands.npz"):
        copy_missing(root / own, folder / own)
    source = open_frames(root, data.views, data.fps)
    if not is_packed(folder):
        # A source of its own for each view, so that images of one at most are in memory.
        views = (open_frames(root, data.views, data.fps).read(range(source.count), [i]) for i in range(len(data.views)))
        write_packed(folder, source.cameras, (view[:, 0].numpy() for view in views), data.fps, margin=margin)
    images = source.count * len(data.views)
    return images, read_packed(folder).size, 4 * images * source.cameras.width * source.cameras.height
