"""The options of `gausim prepare segment`, and what they choose."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.capture.masks.clips import Clip
from data_prep.capture.masks.segmenters import Backend, BackgroundSegmenter, ChromaSegmenter, MaskOf, alpha_masks
from data_prep.common.command import Options, option
from data_prep.common.photos import find_mask, read_mask
from gausim.core import ConfigError

BACKENDS = ("alpha", "masks", "background", "chroma")


def colour(text: str) -> tuple[int, int, int]:
    """Red, green and blue from six hexadecimal digits."""
    try:
        red, green, blue = bytes.fromhex(text.removeprefix("#"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected six hexadecimal digits such as 00b140, got {text!r}") from None
    return red, green, blue


@dataclass(frozen=True)
class ScreenOptions(Options):
    """Of the backends masks, background and chroma."""

    masks: Path | None = option(
        None, "take masks of another program, folders and names like the pictures'", metavar="DIR"
    )
    plate: Path | None = option(
        None, "compare with this picture of the empty scene, or a folder with one per camera (cam_0.png)"
    )
    threshold: float | None = option(
        None, "count differences in CIE Lab above this (from the noise)", least=0, most=200
    )
    key: tuple[int, int, int] | None = option(
        None, "remove this colour of the screen (that of the picture's border)", type=colour, metavar="RRGGBB"
    )
    no_grabcut: bool = option(False, "leave the masks as the difference gives them")


def make_backend(name: str, screen: ScreenOptions) -> Backend:
    """The backend of a name."""
    refine = not screen.no_grabcut
    if name == "masks":
        if screen.masks is None:
            raise ConfigError("--backend masks: name their folder with --masks DIR.")
        return Backend(name, lambda clip: _given_masks(clip, screen.masks), True, inputs=_files_in(screen.masks))
    if name == "background":
        if screen.plate is None:
            raise ConfigError("--backend background: name a picture of the empty scene with --plate.")
        settings: dict[str, Any] = {"threshold": screen.threshold, "grabcut": refine}
        segmenter = BackgroundSegmenter(screen.plate, screen.threshold, refine)
        return Backend(name, segmenter.open, settings=settings, inputs=_files_in(screen.plate))
    if name == "chroma":
        settings = {"key": screen.key, "grabcut": refine}
        return Backend(name, ChromaSegmenter(screen.key, refine).open, settings=settings)
    return Backend(name, alpha_masks, soft=True)


def _files_in(place: Path | None) -> dict[str, Path]:
    """A file, or all of a folder, by name."""
    if place is None or place.is_file():
        return {} if place is None else {place.name: place}
    return {p.relative_to(place).as_posix(): p for p in sorted(place.rglob("*")) if p.is_file()}


def _given_masks(clip: Clip, folder: Path | None) -> MaskOf:
    """Masks that another program has made of the pictures."""

    def mask(index: int) -> np.ndarray:
        assert folder is not None
        found = find_mask(folder, clip.paths[index])
        height, width = clip.rgb(index).shape[:2]
        return read_mask(found, (width, height), clip.paths[index].name).astype(np.float32) / 255

    return mask
