"""Pictures to be segmented: folders of stills, frames of films, as clips that belong together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data_prep.capture.films.film import FILMS, FilmFrames
from data_prep.common.photos import read_picture, write_picture
from gausim.core import DataError
from gausim.io.files import natural
from gausim.io.pixels import SUFFIXES

# Pictures that stages draw for people, and the record that lies beside them.
SHEETS = {"sync.png": "sync.json", "cameras.png": "stage.json"}


@dataclass(frozen=True)
class Clip:
    """Pictures of one folder, in order."""

    name: str  # the folder relative to the input, e.g. ``sequences/seq_000/cam_0``
    root: Path  # the input
    paths: tuple[Path, ...]  # its N pictures relative to ``root``
    moving: bool  # a film of a camera that stands still, so that neighbours in time look alike; else stills

    def __len__(self) -> int:
        """Number of pictures."""
        return len(self.paths)

    def file(self, index: int) -> Path:
        """Path of a picture."""
        return self.root / self.paths[index]

    def rgb(self, index: int) -> np.ndarray:
        """A picture as (H, W, 3) uint8."""
        return np.ascontiguousarray(read_picture(self.file(index))[..., :3])

    @property
    def flat(self) -> str:
        """The name without folders, for files about the whole clip."""
        return self.name.replace("/", "_") or "pictures"


def find_clips(root: Path, *, kind: str = "auto", every: int = 1) -> list[Clip]:
    """All folders with pictures in ``root``, each a clip."""
    folders: dict[str, list[Path]] = {}
    for path in root.rglob("*"):
        relative = path.relative_to(root)
        hidden = any(part.startswith(".") for part in relative.parts)
        drawn = path.name in SHEETS and (path.parent / SHEETS[path.name]).is_file()
        if path.suffix.lower() in SUFFIXES and path.is_file() and not hidden and not drawn:
            folders.setdefault(relative.parent.as_posix().removeprefix("."), []).append(relative)
    if not folders:
        raise DataError(f"{root}: no pictures in it. Pictures are files such as {', '.join(SUFFIXES[:4])}.")
    clips = []
    for name in sorted(folders, key=natural):
        paths = sorted(folders[name], key=lambda p: natural(p.name))
        for first, second in zip(paths, paths[1:], strict=False):
            if first.stem == second.stem:
                raise DataError(f"{root / first}: {second.name} beside it would become the same PNG. Keep one of them.")
        moving = kind == "film" or (kind == "auto" and "sequences" in Path(name).parts)
        clips.append(Clip(name, root, tuple(paths[::every]), moving))
    return clips


def film_frames(film: Path, folder: Path) -> None:
    """Writes a film's frames, upright, as 0000.png and so on; those that are there are kept."""
    frames = FilmFrames(film)
    for i in range(len(frames.facts)):
        path = folder / f"{i:04d}.png"
        if not path.is_file():
            write_picture(path, frames.rgba(i)[..., :3])


def is_film(path: Path) -> bool:
    """Whether this is a film's file."""
    return path.is_file() and path.suffix.lower() in FILMS


def sampled(count: int, most: int) -> Sequence[int]:
    """At most so many indices, evenly spread over ``range(count)``."""
    return [int(i) for i in np.unique(np.linspace(0, count - 1, min(count, most)).round())]
