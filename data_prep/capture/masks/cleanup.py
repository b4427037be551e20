"""Cleaning of raw masks into mattes: agreement over time, holes, crumbs, soft edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from data_prep.common.command import Options, option

# Soft edges are told from empty space by this much alpha.
TRACE = 0.05
# Colour is kept so far around the foreground [pixels], for whoever reduces or warps the picture; beyond it is black.
BORDER = 8


@dataclass(frozen=True)
class Cleanup(Options):
    """Settings of the cleaning of a clip's masks; lengths are fractions of the picture's longer side."""

    radius: int = option(
        2, "agree with so many neighbours in time on each side; 0: none (2)", least=0, metavar="FRAMES"
    )
    motion: float = option(0.02, "allow edges to move so far per frame (0.02)", least=0, most=1)
    holes: float = option(0.02, "fill holes up to this part of the foreground (0.02)", least=0, most=1)
    components: int = option(1, "keep the N largest parts; 0 keeps all (1)", least=0, metavar="N")
    least: float = option(0.0005, "drop parts below this part of the picture (0.0005)", least=0, most=1)
    edge: float = option(0.004, "soften hard edges over this width; 0: not (0.004)", least=0, most=0.1)
    reach: float = option(0.01, "end soft edges so far from the foreground; 0: anywhere (0.01)", least=0, most=1)
    # Any alpha above 0 counts as foreground.
    floor: float = option(0.05, "set alpha below this to 0 (0.05)", least=0, most=1)


UNTOUCHED = Cleanup(radius=0, holes=0.0, components=0, least=0.0, edge=0.0, reach=0.0, floor=0.0)


def steady(mask: np.ndarray, neighbours: Sequence[tuple[int, np.ndarray]], motion: float) -> np.ndarray:
    """A mask (H, W) that differs from its neighbours in time only by what ``motion`` [pixels per frame] explains.

    A neighbour at distance d [frames] says that a pixel's alpha lies between the smallest and the largest alpha that it
    has within ``motion`` d pixels. The mask is moved between bounds with which the majority of frames agree. So what
    flashes up or drops out for a frame goes, and what sways stays.
    """
    agreeing = len(neighbours) // 2
    if agreeing == 0:
        return mask
    highest, lowest = [], []
    for distance, other in neighbours:
        width = 2 * max(1, round(motion * distance)) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (width, width))
        highest.append(cv2.dilate(other, kernel))
        lowest.append(cv2.erode(other, kernel))
    upper = np.sort(highest, axis=0)[-agreeing]
    lower = np.sort(lowest, axis=0)[agreeing - 1]
    return np.minimum(np.maximum(mask, lower), upper)


def cleaned(mask: np.ndarray, rgb: np.ndarray, cleanup: Cleanup, *, soft: bool) -> np.ndarray:
    """One mask with holes filled, crumbs removed and edges softened.

    Returns:
        (H, W) uint8 alpha; above 0 is foreground.
    """
    mask = fill_holes(mask, cleanup.holes)
    mask = keep_largest(mask, cleanup.components, cleanup.least)
    if not soft and cleanup.edge > 0:
        mask = soften(mask, rgb, max(2, round(cleanup.edge * max(mask.shape))))
    if cleanup.reach > 0:
        width = 2 * max(2, round(cleanup.reach * max(mask.shape))) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        # A network's faint guesses elsewhere hang together with the object's edge; they are not its edge.
        mask = np.where(cv2.dilate((mask >= 0.5).astype(np.uint8), kernel) > 0, mask, np.float32(0))
    alpha = np.round(np.where(mask < cleanup.floor, 0, mask) * 255)
    return np.asarray(alpha.clip(0, 255), np.uint8)


def fill_holes(mask: np.ndarray, largest: float) -> np.ndarray:
    """Holes of at most this part of the foreground's area become foreground."""
    inside = mask >= 0.5
    if largest <= 0 or not inside.any():
        return mask
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~inside).astype(np.uint8), connectivity=4)
    touching = set(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]).tolist())
    allowed = largest * float(inside.sum())
    holes = [i for i in range(1, count) if i not in touching and stats[i, cv2.CC_STAT_AREA] <= allowed]
    return np.where(np.isin(labels, holes), np.float32(1), mask) if holes else mask


def keep_largest(mask: np.ndarray, count: int, least: float) -> np.ndarray:
    """Only the largest parts (all with ``count`` 0) of at least ``least`` of the picture, with their soft edges."""
    if count == 0 and least <= 0:
        return mask
    total, labels, stats, _ = cv2.connectedComponentsWithStats((mask >= 0.5).astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    order = np.argsort(-areas, kind="stable")[: count or total]
    kept = [int(i) + 1 for i in order if areas[i] >= least * mask.size]
    cores = np.isin(labels, kept)
    # A part's soft edge hangs together with it where alpha is more than a trace.
    _, traces = cv2.connectedComponents((mask >= TRACE).astype(np.uint8), connectivity=8)
    own = np.isin(traces, np.unique(traces[cores])) & (traces > 0)
    others = (mask >= 0.5) & ~cores
    return np.where(own & ~others, mask, np.float32(0))


def soften(mask: np.ndarray, rgb: np.ndarray, radius: int) -> np.ndarray:
    """Edges that follow the picture's, by the guided filter (He et al. 2010) in a band around the mask's own edge."""
    binary = (mask >= 0.5).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    band = cv2.dilate(binary, kernel) != cv2.erode(binary, kernel)
    guide = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.boxFilter(values, -1, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_REFLECT))

    target = binary.astype(np.float32)
    mean_guide, mean_target = mean(guide), mean(target)
    variance = mean(guide * guide) - mean_guide**2
    slope = (mean(guide * target) - mean_guide * mean_target) / (variance + 1e-3)
    offset = mean_target - slope * mean_guide
    filtered = np.clip(mean(slope) * guide + mean(offset), 0, 1)
    return np.where(band, filtered, target).astype(np.float32)


def matte(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Straight-alpha RGBA, (H, W, 4) uint8; colour far from the foreground is black, which keeps files small."""
    kernel = np.ones((2 * BORDER + 1, 2 * BORDER + 1), np.uint8)
    near = cv2.dilate((alpha > 0).astype(np.uint8), kernel)
    return np.dstack([rgb * near[..., None], alpha])


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of two masks' foreground; 1 where both are empty."""
    a, b = first > 127, second > 127
    union = int((a | b).sum())
    return float((a & b).sum()) / union if union else 1.0
