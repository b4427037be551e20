"""Pictures to be segmented: folders of stills, frames of films, as clips that belong together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from data_prep.capture.films.film import pictures, probe, upright
from data_prep.capture.films.takes import FILMS
from data_prep.common.photos import SUFFIXES, natural, write_image
from gausim.core import DataError
from gausim.io.pixels import decode

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

    def rgba(self, index: int) -> np.ndarray:
        """A picture as (H, W, 4) uint8 with straight alpha; opaque where the file has none."""
        return read_picture(self.file(index))

    def rgb(self, index: int) -> np.ndarray:
        """A picture as (H, W, 3) uint8."""
        return np.ascontiguousarray(self.rgba(index)[..., :3])

    @property
    def flat(self) -> str:
        """The name without folders, for files about the whole clip."""
        return self.name.replace("/", "_") or "pictures"


def find_clips(root: Path, *, kind: str = "auto", every: int = 1) -> list[Clip]:
    """All folders with pictures in ``root``, each a clip.

    Raises:
        DataError: there are none, or two pictures would become one PNG.
    """
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
    facts = probe(film)
    if len(list(folder.glob("*.png"))) == len(facts):
        return
    for i, frame in pictures(facts):
        path = folder / f"{i:04d}.png"
        if not path.is_file():
            write_picture(path, upright(facts, frame))


def is_film(path: Path) -> bool:
    """Whether this is a film's file."""
    return path.is_file() and path.suffix.lower() in FILMS


def read_picture(path: Path) -> np.ndarray:
    """Decodes a picture to (H, W, 4) uint8 RGBA with straight alpha; its pixels are as stored (EXIF is not applied).

    Raises:
        DataError: it cannot be decoded, or its values are no integers of 8 or 16 bit.
    """
    pixels = decode(path)
    if pixels is None:
        raise DataError(f"{path}: cannot be decoded as a picture. Export it again as PNG.")
    if pixels.dtype == np.uint16:
        pixels = np.round(pixels / 257.0).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise DataError(f"{path}: expected 8 or 16 bit per channel, got {pixels.dtype}. Export it again as 8-bit PNG.")
    if pixels.ndim == 2:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGBA))
    if pixels.shape[2] == 2:  # grey with alpha
        return np.ascontiguousarray(pixels[..., [0, 0, 0, 1]])
    code = cv2.COLOR_BGR2RGBA if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA
    return np.asarray(cv2.cvtColor(pixels, code))


def write_picture(path: Path, pixels: np.ndarray) -> None:
    """Writes (H, W), (H, W, 3) RGB or (H, W, 4) RGBA uint8 as PNG (or JPEG by its name), whole or not at all."""
    code = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}.get(pixels.shape[2] if pixels.ndim == 3 else 1)
    write_image(path, pixels if code is None else cv2.cvtColor(pixels, code), 1)


def sampled(count: int, most: int) -> Sequence[int]:
    """At most so many indices, evenly spread over ``range(count)``."""
    return [int(i) for i in np.unique(np.linspace(0, count - 1, min(count, most)).round())]
