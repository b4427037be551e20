"""Foreground masks: what every backend gives, and the backends that need OpenCV alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from data_prep.capture.masks.clips import Clip, sampled
from data_prep.common.photos import read_mask, read_picture
from gausim.core import DataError

MaskOf = Callable[[int], np.ndarray]

# Frames that tell the noise of a clip.
NOISE_FRAMES = 15
# A difference in CIE Lab counts from here on, and from so many times the noise; 2.3 is just noticeable.
LEAST_DIFFERENCE, OVER_NOISE = 7.0, 5.0
# Distances in the a-b plane of CIE Lab up to which a pixel is screen, and from which it is not.
SCREEN, OBJECT = 14.0, 32.0
GRABCUT_SIDE = 480
GRABCUT_ROUNDS = 3


@dataclass(frozen=True)
class Backend:
    """A way to tell foreground from background, with what its result depends on."""

    name: str  # of the backend
    # Looks at a clip and returns what gives a picture's mask. That is called with rising indices, not necessarily all
    # of them, and returns (H, W) float32 in 0..1, 1 being foreground.
    open: Callable[[Clip], MaskOf]
    soft: bool = False  # masks have soft edges of their own; others are softened along the picture's edges
    settings: Mapping[str, Any] = field(default_factory=dict)  # what was chosen (plain data)
    inputs: Mapping[str, Path] = field(default_factory=dict)  # files it reads besides the pictures


def alpha_masks(clip: Clip) -> MaskOf:
    """The alpha channel that the pictures have already; a picture without any transparency is refused."""

    def mask(index: int) -> np.ndarray:
        path = clip.file(index)
        alpha = read_picture(path)[..., 3]
        if alpha.min() == 255:
            raise DataError(f"{path}: has no transparent pixel, so its alpha is no mask. Choose another --backend.")
        return read_mask(path, (alpha.shape[1], alpha.shape[0]), path.name).astype(np.float32) / 255

    return mask


@dataclass(frozen=True)
class BackgroundSegmenter:
    """Pixels that differ from the empty scene."""

    plate: Path  # picture of the empty scene, or a folder with one per camera (named like the clip's folder)
    threshold: float | None = None  # difference in CIE Lab from which a pixel counts; from the noise when None
    grabcut: bool = True  # refine by GrabCut

    def open(self, clip: Clip) -> MaskOf:
        """See :class:`Backend`."""
        background = lab(_read_plate(self.plate, clip))
        far = [difference(lab(clip.rgb(i)), background, clip, i) for i in sampled(len(clip), NOISE_FRAMES)]
        noise = 1.4826 * float(np.median([np.median(d) for d in far]))
        threshold = self.threshold or max(LEAST_DIFFERENCE, OVER_NOISE * noise)

        def mask(index: int) -> np.ndarray:
            rgb = clip.rgb(index)
            far = difference(lab(rgb), background, clip, index)
            if not self.grabcut:
                return np.clip((far - 0.5 * threshold) / threshold, 0, 1).astype(np.float32)
            return grabcut(rgb, trimap(far, threshold))

        return mask


def _read_plate(path: Path, clip: Clip) -> np.ndarray:
    if path.is_dir():
        names = (clip.name, Path(clip.name).name)
        found = [path / f"{n}{end}" for n in names for end in (".png", ".jpg") if (path / f"{n}{end}").is_file()]
        if not found:
            raise DataError(f"{path}: no picture of the empty scene for '{clip.name}', expected {names[1]}.png.")
        path = found[0]
    plate, shape = read_picture(path)[..., :3], clip.rgb(0).shape
    if plate.shape != shape:
        raise DataError(
            f"{path}: is {plate.shape[1]}x{plate.shape[0]}, the pictures of '{clip.name}' are {shape[1]}x{shape[0]}."
        )
    return np.ascontiguousarray(plate)


@dataclass(frozen=True)
class ChromaSegmenter:
    """Pixels whose hue differs from that of a screen."""

    key: tuple[int, int, int] | None = None  # the screen's colour (RGB, 0..255); that of the picture's border when None
    grabcut: bool = True  # refine by GrabCut

    def open(self, clip: Clip) -> MaskOf:
        """See :class:`Backend`."""
        first = lab(clip.rgb(0))
        border = np.concatenate([first[0], first[-1], first[:, 0], first[:, -1]])
        key = np.median(border, axis=0) if self.key is None else lab(np.full((1, 1, 3), self.key, np.uint8))[0, 0]
        if np.hypot(key[1], key[2]) < 15:
            raise DataError(
                f"{clip.file(0)}: the screen's colour is nearly grey, so its hue is undefined. State it with --key, or "
                "choose another --backend."
            )

        def mask(index: int) -> np.ndarray:
            rgb = clip.rgb(index)
            distance = np.linalg.norm(lab(rgb)[..., 1:] - key[1:], axis=-1)
            soft = np.clip((distance - SCREEN) / (OBJECT - SCREEN), 0, 1).astype(np.float32)
            if not self.grabcut:
                return soft
            marks = np.where(soft > 0.5, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
            marks[soft == 0], marks[soft == 1] = cv2.GC_BGD, cv2.GC_FGD
            return grabcut(rgb, marks)

        return mask


def lab(rgb: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB to CIE Lab, float32, slightly blurred against noise."""
    return cv2.GaussianBlur(cv2.cvtColor(rgb.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), (0, 0), 1.0)


def difference(picture: np.ndarray, background: np.ndarray, clip: Clip, index: int) -> np.ndarray:
    """Distance of (H, W, 3) Lab pictures by pixel, after the change that all pixels share (exposure) is taken away."""
    if picture.shape != background.shape:
        raise DataError(
            f"{clip.file(index)}: is {picture.shape[1]}x{picture.shape[0]}, the background is "
            f"{background.shape[1]}x{background.shape[0]}. Pictures of a clip have one size."
        )
    delta = picture - background
    return np.asarray(np.linalg.norm(delta - np.median(delta, axis=(0, 1)), axis=-1))


def trimap(far: np.ndarray, threshold: float) -> np.ndarray:
    """GrabCut's marks from (H, W) differences: the object is where they are large."""
    margin = max(3, round(0.02 * max(far.shape))) | 1
    marks = np.full(far.shape, cv2.GC_BGD, np.uint8)
    region = cv2.morphologyEx((far > threshold).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    near = cv2.dilate(region, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1)))
    marks[near > 0] = cv2.GC_PR_BGD
    marks[region > 0] = cv2.GC_PR_FGD
    marks[cv2.erode((far > 2 * threshold).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0] = cv2.GC_FGD
    return marks


def grabcut(rgb: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """GrabCut (Rother et al. 2004) from marks per pixel, at a reduced size; returns an (H, W) float32 mask.

    Without any possible foreground the mask is empty; without any background it is full.
    """
    height, width = marks.shape
    scale = min(1.0, GRABCUT_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    labels = cv2.resize(marks, size, interpolation=cv2.INTER_NEAREST)
    foreground = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if foreground.sum() < 16:
        return np.zeros(marks.shape, np.float32)
    if (~foreground).sum() < 16:
        return np.ones(marks.shape, np.float32)
    cv2.setRNGSeed(0)  # its colour models start from random clusters
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(small, labels, None, *models, GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    mask = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.float32)
    return np.clip(cv2.resize(mask, (width, height), interpolation=cv2.INTER_LINEAR), 0, 1)
