"""Finds all faults of a data set on disk, not only the first that would stop a training."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from gausim.core import GausSimError
from gausim.data.objects import ObjectData
from gausim.data.records import SequenceRecord
from gausim.io.files import sha256
from gausim.io.plain_json import read_json

# Manifest of the data preparation stages; a packed store contains only the files that it lists.
MANIFEST = "stage.json"
CLOSED = "pack"
FRAMES_AT_A_TIME = 8


@dataclass(frozen=True)
class Fault:
    """One fault of a data set."""

    where: str  # file or folder, relative to the object if it is inside
    what: str  # description and remedy


def verify(root: Path, *, quick: bool = False, scene: bool = True) -> list[Fault]:
    """The faults of one object: facts, sequences with all their images, true motion, stills, scene, hashes of a store.

    ``quick`` checks headers and sizes only, without reading images or computing hashes; ``scene``: scene and masks
    too.
    """
    faults = list(_manifest(root, quick=quick))
    try:
        data = ObjectData(root)
    except GausSimError as error:
        return [*faults, Fault("dataset.json", str(error))]
    faults += _sequences(data, quick=quick)
    if scene and data.scene_path.is_file():
        faults += _check("scene.ply", data.scene)
    if (root / "static").is_dir() and not quick:
        faults += _check("static", data.stills)
    return faults


def _check(where: str, action: Callable[[], object]) -> list[Fault]:
    try:
        action()
    except (GausSimError, OSError) as error:
        return [Fault(where, str(error))]
    return []


def _sequences(data: ObjectData, *, quick: bool) -> Iterator[Fault]:
    folder = data.root / "sequences"
    names = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
    if not names:
        yield Fault("sequences", f"{folder}: holds no sequence. Restore the folder, or record some.")
    for name in names:
        where = f"sequences/{name}"
        try:
            record = SequenceRecord(folder / name, views=data.views, fps=data.fps)
        except GausSimError as error:
            yield Fault(where, str(error))
            continue
        if record.count < data.train_frames.stop:
            yield Fault(where, f"has {record.count} frames, dataset.json trains on {data.train_frames}.")
        absent = record.absent()
        if absent:
            first = Path(os.path.relpath(absent[0], folder)).as_posix()
            yield Fault(
                where,
                f"{len(absent)} of its images are missing, though its transforms.json names them (first: {first}). "
                "Restore them, or cut all cameras before the gap and number the frames again.",
            )
        elif not quick:
            yield from _images(record, where)
        yield from _check(f"{where}/ground_truth.npz", partial(data.ground_truth, record))


def _images(record: SequenceRecord, where: str) -> Iterator[Fault]:
    """Reads every image and checks that its mask shows the object."""
    most = dict.fromkeys(record.views, 0)
    for start in range(0, record.count, FRAMES_AT_A_TIME):
        for view in record.views:
            try:
                found = record.frames(range(start, min(start + FRAMES_AT_A_TIME, record.count)), [view])
            except GausSimError as error:
                yield Fault(where, str(error))
                return
            most[view] = max(most[view], int(found[..., 3].max()))
    for view, value in most.items():
        if value == 0:
            yield Fault(where, f"view '{view}' never shows the object (alpha is 0). Take it out, or mask it again.")
        elif value < 128:
            yield Fault(
                where,
                f"the masks of view '{view}' never exceed {value} of 255: labels or colours were taken for alpha. "
                "Write them again as 0 and 255.",
            )


def _manifest(root: Path, *, quick: bool) -> Iterator[Fault]:
    """Checks presence, size and content of the files of a manifest; a packed store may contain no others."""
    path = root / MANIFEST
    if not path.is_file():
        return
    try:
        manifest = read_json(path)
        listed = manifest["results"]["files"]
        known = {str(name): (int(entry["bytes"]), str(entry["sha256"])) for name, entry in listed.items()}
    except (GausSimError, KeyError, TypeError, ValueError, AttributeError) as error:
        yield Fault(MANIFEST, f"lists no files ({error}). Make it again.")
        return
    for name, (size, content) in known.items():
        file = root / name
        if not file.is_file():
            yield Fault(name, "is missing. Restore it, or make the set again.")
        elif file.stat().st_size != size:
            yield Fault(name, f"has {file.stat().st_size} bytes, {MANIFEST} says {size}. Make it again.")
        elif not quick and sha256(file) != content:
            yield Fault(name, f"is not the file that {MANIFEST} lists (SHA-256 differs). Make it again.")
    if manifest.get("stage") != CLOSED:
        return
    for file in sorted(p for p in root.rglob("*") if p.is_file()):
        name = str(file.relative_to(root))
        if name not in known and name != MANIFEST:
            yield Fault(name, f"is not in {MANIFEST}. Remove it, or pack the object again.")
