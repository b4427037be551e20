"""Fingerprints of the sequences that a run is trained on, and what has changed of them since."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct

from gausim.core import RunError
from gausim.data.objects import ObjectData
from gausim.io.files import sha256, write_durably
from gausim.io.plain_json import checked, read_json

DATA = "data.json"
_NAMED = 3


class _Print(Struct):
    sequences: list[str]  # in the order of their numbers
    files: dict[str, tuple[int, int, str]]  # by their names: bytes, time of the last change [ns], SHA-256


def write_prints(run: Path, objects: Sequence[ObjectData]) -> None:
    """Stores the fingerprints of the objects' sequences in a run."""
    found = {}
    for item in objects:
        stats = {name: (path.stat(), sha256(path)) for name, path in _files(item) if path.is_file()}
        files = {name: (stat.st_size, stat.st_mtime_ns, content) for name, (stat, content) in stats.items()}
        found[item.name] = {"sequences": [record.name for record in item.sequences], "files": files}
    write_durably(run / DATA, json.dumps(found, separators=(",", ":")).encode() + b"\n")


def changed_files(run: Path, objects: Sequence[ObjectData]) -> str:
    """A sentence on files that are not what the run was trained on; empty if there are none.

    A file of the same size and time counts as unchanged; one of another time is hashed.

    Raises:
        RunError: an object has other sequences than those that the run has states of.
    """
    if not (run / DATA).is_file():
        return ""
    texts = []
    stored: dict[str, Any] = read_json(run / DATA)
    for item in objects:
        known = checked(stored.get(item.name, {}), _Print, f"{run / DATA}: {item.name}", "Train the run again.")
        _check_sequences(run, item, known.sequences)
        paths = dict(_files(item))
        changed = [
            name for name, entry in known.files.items() if _has_changed(paths.get(name, item.root / name), entry)
        ]
        if changed:
            more = " …" if len(changed) > _NAMED else ""
            texts.append(
                f"{item.root}: {len(changed)} of {len(known.files)} files were replaced or removed since {run} was "
                f"trained on them ({', '.join(changed[:_NAMED])}{more})."
            )
    return " ".join(texts)


def _check_sequences(run: Path, item: ObjectData, known: list[str]) -> None:
    now = [record.name for record in item.sequences]
    if now == known:
        return
    gone = [name for name in known if name not in item.names]
    why = f"{', '.join(gone)} is gone" if gone else f"it now has {item.names}"
    raise RunError(
        f"{item.root}: {run} was trained on {known}, but the data now give {now} ({why}). Restore the sequences, give "
        "the data set it was trained on, or train anew under another name."
    )


def _files(item: ObjectData) -> Iterator[tuple[str, Path]]:
    """The files that training reads of an object, by their names below its directory."""
    yield "dataset.json", item.root / "dataset.json"
    for record in item.sequences:
        for path in record.files():
            inside = path.is_relative_to(item.root)
            yield path.relative_to(item.root).as_posix() if inside else str(path), path


def _has_changed(path: Path, entry: tuple[int, int, str]) -> bool:
    size, time, content = entry
    if not path.is_file() or path.stat().st_size != size:
        return True
    return path.stat().st_mtime_ns != time and sha256(path) != content
