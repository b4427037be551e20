"""Assignment of films to sequences and cameras: a folder of folders, one folder, or a list file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from data_prep.common.photos import natural
from gausim.core import DataError
from gausim.io.plain_json import checked, read_json

_Seconds = Annotated[float, Meta(ge=0, le=1e6)]


class _Listed(Struct, forbid_unknown_fields=True):
    """One sequence of a list file."""

    cameras: Annotated[dict[str, Annotated[str, Meta(min_length=1)]], Meta(min_length=1)]
    name: str | int | float | None = None
    offsets: dict[str, str | int | float] = {}
    start: _Seconds | None = None
    duration: _Seconds | None = None


class _List(Struct):
    sequences: Annotated[list[_Listed], Meta(min_length=1)]


FILMS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".mxf")


@dataclass(frozen=True)
class Take:
    """One sequence before it is synchronised."""

    name: str  # its folder in the output, seq_000 and so on
    source: str  # what the user calls it
    films: Mapping[str, Path]  # file by camera (cam_0 and so on)
    labels: Mapping[str, str]  # what the user calls each camera
    offsets: Mapping[str, str] = field(default_factory=dict)  # by camera, as given: seconds, or frames with an ``f``
    start: float | None = None  # what is left out at the beginning of the common time [s]
    duration: float | None = None  # how much of it is kept [s]; all when None


def find_takes(path: Path) -> list[Take]:
    """The sequences that a folder or list file (``.json``) names.

    A folder holds one folder per sequence, each with one film per camera, named alike in all; or the films of a single
    sequence. A list file says it outright, its paths relative to itself (:data:`data_prep.ingest.LAYOUT`).

    Cameras become cam_0, cam_1 … in the natural order of their names, sequences seq_000 … in that of theirs (in a list,
    in its own).

    Raises:
        DataError: nothing is there, it is ambiguous, or cameras differ between sequences.
    """
    named: list[tuple[str, dict[str, Path], dict[str, Any]]]
    if path.is_dir():
        named = [(name, _by_stem(folder), {}) for name, folder in _folders(path)]
    elif path.suffix.lower() == ".json":
        named = _listed(path)
    else:
        raise DataError(f"{path}: expected a folder of films, or a list file (.json).")
    cameras = sorted(named[0][1], key=natural)
    labels = {f"cam_{i}": label for i, label in enumerate(cameras)}
    takes = []
    for i, (name, films, extra) in enumerate(named):
        if set(films) != set(cameras):
            raise DataError(
                f"{path}: sequence '{name}' has the cameras {sorted(films, key=natural)}, '{named[0][0]}' has "
                f"{cameras}. Name the films alike in every sequence, or say which is which in a list file (see --help)."
            )
        by_camera = {camera: films[label] for camera, label in labels.items()}
        takes.append(Take(f"seq_{i:03d}", name, by_camera, labels, **extra))
    return takes


def offset_seconds(text: str, rate: float) -> float:
    """Seconds of an offset as people write it: ``0.146``, ``0.146s``, or ``7.3f`` in frames of that camera.

    Raises:
        DataError: it is none.
    """
    match = re.fullmatch(r"\s*([+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)\s*([sf]?)\s*", text)
    value = float(match[1]) if match else math.nan
    if match is None or not math.isfinite(value):
        raise DataError(f"offset {text!r}: expected seconds such as 0.146, or frames such as 7.3f.")
    return value / rate if match[2] == "f" else value


def _folders(path: Path) -> list[tuple[str, Path]]:
    inner = [p for p in sorted(path.iterdir(), key=lambda p: natural(p.name)) if p.is_dir() and _films(p)]
    if inner and _films(path):
        raise DataError(f"{path}: films lie both in it and in {inner[0].name}. One folder per sequence, please.")
    if not inner and not _films(path):
        raise DataError(f"{path}: no films in it or in its folders. Films are files such as {', '.join(FILMS[:5])}.")
    return [(p.name, p) for p in inner] or [(path.resolve().name, path)]


def _films(folder: Path) -> list[Path]:
    return [p for p in folder.iterdir() if p.suffix.lower() in FILMS and p.is_file() and not p.name.startswith(".")]


def _by_stem(folder: Path) -> dict[str, Path]:
    films: dict[str, Path] = {}
    for film in sorted(_films(folder)):
        if film.stem in films:
            raise DataError(f"{folder}: {films[film.stem].name} and {film.name} name one camera. Keep one of them.")
        films[film.stem] = film
    return films


def _listed(path: Path) -> list[tuple[str, dict[str, Path], dict[str, Any]]]:
    found = []
    for i, entry in enumerate(checked(read_json(path), _List, str(path), "See --help for the form.").sequences):
        offsets = {name: str(value) for name, value in entry.offsets.items()}
        extra = {"offsets": offsets, "start": entry.start, "duration": entry.duration}
        films = {name: path.parent / value for name, value in entry.cameras.items()}
        found.append((str(i if entry.name is None else entry.name), films, extra))
    return found
