"""Time offset between two cameras, by a light that was switched on in view of both.

The mean brightness of each picture, in linear light, steps up when a lamp goes on. A picture exposed while it happened
has part of the step, which tells when within the exposure it was. Several flashes are matched by their pattern.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gausim.core import DataError

# Encoded values to linear light; cameras' curves are near this.
GAMMA = 2.2
# A step counts that is this many times the usual change of two frames, and this part of the full range.
OVER_NOISE, LEAST_STEP = 8.0, 0.004
# Of several steps those are flashes that are at least this part of the largest.
OF_LARGEST = 0.4
# Flashes of two films are the same ones if their times agree to this [frames].
SAME = 0.75


@dataclass(frozen=True)
class Flash:
    """A light that went on."""

    seconds: float  # when, on the film's clock [s]
    resolution: float  # what the pictures can tell of it [s]


def brightness(gray: np.ndarray) -> float:
    """Mean of an (H, W) uint8 picture in linear light, 0..1."""
    return float(np.bincount(gray.reshape(-1), minlength=256) @ _LINEAR / gray.size)


_LINEAR = (np.arange(256) / 255.0) ** GAMMA


def flashes(levels: np.ndarray, times: np.ndarray, *, interval: float, shutter: float = 1.0) -> list[Flash]:
    """When a light went on.

    Args:
        levels: brightness of N frames in linear light, 0..1.
        times: when each frame's exposure begins [s].
        interval: time between frames [s].
        shutter: exposure as part of the interval; 1 suits rolling shutters too, whose rows share the interval.

    Raises:
        DataError: there is no step that stands out.
    """
    if len(levels) < 4:
        raise DataError(f"{len(levels)} frames are too few to find a flash.")
    rise = levels[2:] - levels[:-2]  # around frame k = index + 1
    usual = 1.4826 * float(np.median(np.abs(rise - np.median(rise))))
    largest = float(rise.max())
    needed = max(OVER_NOISE * usual, LEAST_STEP)
    if largest < needed:
        raise DataError(
            f"no flash: its largest step of brightness is {largest:.4f}, needed {needed:.4f} of full range."
        )
    found: list[Flash] = []
    for i in np.flatnonzero(rise >= max(needed, OF_LARGEST * largest)):
        if rise[i] < rise[max(i - 1, 0) : i + 2].max() or (i > 0 and rise[i - 1] == rise[i]):
            continue
        found.append(_edge(levels, times, int(i) + 1, interval, shutter))
    return found


def flash_lag(first: list[Flash], second: list[Flash], *, interval: float) -> tuple[float, float, float]:
    """By how much the second film began later than the first, from the flashes that both saw.

    Returns:
        The difference of starts, the largest disagreement between flashes, and what they can tell apart, all in [s].

    Raises:
        DataError: their flashes can be matched in several ways.
    """
    ways = [_matched(first, second, a.seconds - b.seconds, SAME * interval) for a in first for b in second]
    most = max(len(pairs) for pairs in ways)
    best = [pairs for pairs in ways if len(pairs) == most]
    lags = [float(np.mean([a.seconds - b.seconds for a, b in pairs])) for pairs in best]
    if np.ptp(lags) > SAME * interval:
        raise DataError(
            f"the reference saw {len(first)} flashes, it saw {len(second)}, and they match in several ways (lags of "
            f"{min(lags):.3f} s to {max(lags):.3f} s). Cut the films so that both hold the same flashes."
        )
    differences = np.array([a.seconds - b.seconds for a, b in best[0]])
    resolution = max(a.resolution + b.resolution for a, b in best[0])
    return float(differences.mean()), float(np.ptp(differences)), resolution


def _edge(levels: np.ndarray, times: np.ndarray, k: int, interval: float, shutter: float) -> Flash:
    """The moment of the step around frame k, of which the frame may have seen a part."""
    below, above = levels[k - 1], levels[k + 1]
    after = levels[k + 2 : k + 4]
    if len(after) and after.min() < below + 0.5 * (above - below):
        # A flash of a frame or two: the middle of its light, known to half a frame.
        span = slice(k - 1, k + 3)
        light = np.clip(levels[span] - below, 0, None)
        middle = float((light * times[span]).sum() / light.sum()) + 0.5 * shutter * interval
        return Flash(middle, 0.5 * interval)
    seen = float(np.clip((levels[k] - below) / max(above - below, 1e-12), 0.0, 1.0))
    return Flash(float(times[k]) + (1 - seen) * shutter * interval, 0.1 * interval)


def _matched(first: list[Flash], second: list[Flash], lag: float, within: float) -> list[tuple[Flash, Flash]]:
    pairs: list[tuple[Flash, Flash]] = []
    taken: set[int] = set()
    for a in first:
        near = [(abs(a.seconds - b.seconds - lag), j) for j, b in enumerate(second) if j not in taken]
        distance, j = min(near, default=(np.inf, -1))
        if distance <= within:
            taken.add(j)
            pairs.append((a, second[j]))
    return pairs
