"""Assignment of films to sequences and cameras: a folder of folders, or one folder."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from data_prep.capture.films.film import FILMS
from gausim.core import DataError
from gausim.io.files import natural


@dataclass(frozen=True)
class Take:
    """One sequence before it is synchronised."""

    name: str  # its folder in the output, seq_000 and so on
    source: str  # what the user calls it
    films: Mapping[str, Path]  # file by camera (cam_0 and so on)
    labels: Mapping[str, str]  # what the user calls each camera

    def camera(self, name: str, what: str) -> str:
        """The camera that the user calls so, by the output's name or the film's."""
        for camera, label in self.labels.items():
            if name in (camera, label):
                return camera
        raise DataError(f"{what}: no camera '{name}'; there are {dict(self.labels)}.")


def find_takes(path: Path) -> list[Take]:
    """The sequences in a folder.

    It holds one folder per sequence, each with one film per camera, named alike in all; or the films of a single
    sequence. Cameras become cam_0, cam_1 … in the natural order of their names, sequences seq_000 … in that of theirs.
    """
    if not path.is_dir():
        raise DataError(f"{path}: no such folder. Expected one of films, or one folder of films per sequence.")
    inner = [p for p in sorted(path.iterdir(), key=lambda p: natural(p.name)) if p.is_dir() and _films(p)]
    if inner and _films(path):
        raise DataError(f"{path}: films lie both in it and in {inner[0].name}. One folder per sequence, please.")
    named = {p.name: _films(p) for p in inner} or {path.resolve().name: _films(path)}
    first, cameras = next(iter(named)), sorted(next(iter(named.values())), key=natural)
    if not cameras:
        raise DataError(f"{path}: no films in it or in its folders. Films are files such as {', '.join(FILMS[:5])}.")
    labels = {f"cam_{i}": label for i, label in enumerate(cameras)}
    for name, films in named.items():
        if set(films) != set(cameras):
            raise DataError(
                f"{path}: sequence '{name}' has the cameras {sorted(films, key=natural)}, '{first}' has {cameras}. "
                "Name the films alike in every sequence."
            )
    return [
        Take(f"seq_{i:03d}", name, {camera: films[label] for camera, label in labels.items()}, labels)
        for i, (name, films) in enumerate(named.items())
    ]


def offset_seconds(text: str, rate: float) -> float:
    """Seconds of an offset as people write it: ``0.146``, ``0.146s``, or ``7.3f`` in frames of that camera."""
    match = re.fullmatch(r"\s*([+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)\s*([sf]?)\s*", text)
    value = float(match[1]) if match else math.nan
    if match is None or not math.isfinite(value):
        raise DataError(f"offset {text!r}: expected seconds such as 0.146, or frames such as 7.3f.")
    return value / rate if match[2] == "f" else value


def _films(folder: Path) -> dict[str, Path]:
    """Films in a folder by the names of their cameras."""
    films: dict[str, Path] = {}
    for film in sorted(folder.iterdir()):
        if film.suffix.lower() in FILMS and film.is_file() and not film.name.startswith("."):
            if film.stem in films:
                raise DataError(f"{folder}: {films[film.stem].name} and {film.name} name one camera. Keep one of them.")
            films[film.stem] = film
    return films
