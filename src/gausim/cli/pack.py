"""Packing of a finished run or a data set for publication, with its entry for a registry."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gausim.compose.data_paths import FETCHED, SCENES, outside_files
from gausim.core.errors import FetchError, RunError
from gausim.data.objects import find_objects
from gausim.io.archive import files_below, pack
from gausim.io.files import sha256
from gausim.io.registry import Entry, check_name, entry_text
from gausim.io.transforms import read_json
from gausim.report.card import CARD
from gausim.runs.checkpoint import LAST_CHECKPOINT, read_checkpoint
from gausim.runs.directory import CONFIG, FINISHED, RunDirectory
from gausim.runs.names import EPOCHS, MOTION

# Files of a run to publish; logs, panels and films are excluded, as they identify the machine and its user.
_OF_A_RUN = (CONFIG, LAST_CHECKPOINT, FINISHED, EPOCHS, MOTION, CARD)
_LICENCES = ("licence", "license")


def pack_published(source: Path, out: Path, *, name: str, title: str | None, licence: str | None, data: str) -> str:
    """Packs a finished run or a data set into ``out/NAME.tar``, its card beside it; returns its entry in TOML.

    The title is made from the names of the objects when None, the licence is that of ``dataset.json``; ``data`` is
    the entry of a run's data set, or empty.

    Raises:
        FetchError: the name is invalid, or the licence is unknown.
        RunError: the run is not finished, or its checkpoint is damaged.
        DataError: there is no data set, or it contains a link.
    """
    archive = out / f"{name}.tar"
    check_name(name)
    is_run = (source / CONFIG).is_file()
    files, objects, stated = _of_run(source) if is_run else _of_data(source)
    known = licence or stated
    if not known:
        raise FetchError(
            f"{source}: under which licence may others use it? Give --licence ID, e.g. CC-BY-4.0"
            f"{'' if is_run else ', or write it into dataset.json (licence)'}."
        )
    unpacked = pack(archive, {f"{name}/{path}": file for path, file in files.items()})
    card = files.get(CARD)
    if card is not None:
        shutil.copyfile(card, out / f"{name}.md")
    # Only the entry goes to the standard output.
    print(f"wrote {archive} ({archive.stat().st_size / 1e6:,.1f} MB, {len(files)} files)", file=sys.stderr)
    if is_run:
        root = json.dumps(RunDirectory(source).config()["data"].get("root"))
        print(f"note: its {CONFIG} contains the path of your data: {root}", file=sys.stderr)
    if is_run and card is None:
        print(f"note: the run has no card. Write one with `gausim card {source}` and pack again.", file=sys.stderr)
    entry = Entry(
        name=name, kind="run" if is_run else "data", file=archive.name, sha256=sha256(archive),
        title=title or f"{'trained on ' if is_run else ''}{', '.join(objects)}", size=archive.stat().st_size,
        unpacked=unpacked, licence=known, card=f"{name}.md" if card is not None else "", data=data,
    )  # fmt: skip
    return f"# addresses: where {archive.name} will lie, URLs or paths relative to the registry.\n{entry_text(entry)}"


def _of_run(source: Path) -> tuple[dict[str, Path], list[str], str | None]:
    """Files of a run by their names in the archive, its objects, and no licence."""
    run = RunDirectory(source)
    if not run.is_finished:
        raise RunError(f"{source}: expected a finished run, found none ({FINISHED} is missing). Train it to its end.")
    checkpoint = read_checkpoint(run.checkpoint)
    own = {name: source / name for name in _OF_A_RUN if (source / name).is_file()}
    evaluation = source / "evaluation"
    if evaluation.is_dir():
        own |= {str(file.relative_to(source).as_posix()): file for file in files_below(evaluation)}
    objects = [str(scene["name"]) for scene in checkpoint["gausim"]["scenes"]]
    return own | _scenes(source, run.config()["data"]), objects, None


def _scenes(source: Path, data: Mapping[str, Any]) -> dict[str, Path]:
    """Rest scenes and masks from outside the data set, which are packed with the run."""
    found: dict[str, Path] = {}
    for path in outside_files(source, data):
        name = f"{SCENES}/{path.name}"
        if found.setdefault(name, path) != path:
            raise RunError(f"{source}/{CONFIG}: names two scenes {path.name}. Rename one and train again.")
    return found


def _of_data(source: Path) -> tuple[dict[str, Path], list[str], str | None]:
    """Files of a data set by their names in the archive, its objects, and their licence if all state the same."""
    objects, licences = [], set()
    for root in find_objects(source):
        facts = read_json(root / "dataset.json")
        objects.append(str(facts.get("name", root.name)))
        licences.add(next((facts[key] for key in _LICENCES if isinstance(facts.get(key), str)), None))
    files = {file.relative_to(source).as_posix(): file for file in files_below(source)}
    files.pop(FETCHED, None)
    return files, objects, licences.pop() if len(licences) == 1 else None
