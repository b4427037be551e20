"""Time offset between two cameras, by a light that was switched on in view of both.

The mean brightness of each picture, in linear light, steps up when a lamp goes on. A picture exposed while it happened
has part of the step, which tells when within the exposure it was. Several flashes are matched by their pattern.
"""

from __future__ import annotations

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
# What the pictures can tell of a lamp that stays on [frames].
RESOLUTION = 0.1
_LINEAR = (np.arange(256) / 255.0) ** GAMMA


def brightness(gray: np.ndarray) -> float:
    """Mean of an (H, W) uint8 picture in linear light, 0..1."""
    return float(np.bincount(gray.reshape(-1), minlength=256) @ _LINEAR / gray.size)


def flashes(levels: np.ndarray, times: np.ndarray, *, interval: float) -> list[float]:
    """When a lamp went on that stayed on for a few frames [s].

    Args:
        levels: brightness of N frames in linear light, 0..1.
        times: when each frame's exposure begins [s].
        interval: time between frames [s], which the exposure is taken to last.
    """
    if len(levels) < 4:
        raise DataError(f"{len(levels)} frames are too few to find a flash.")
    rise = levels[2:] - levels[:-2]  # around frame k = index + 1
    usual = 1.4826 * float(np.median(np.abs(rise - np.median(rise))))
    largest, needed = float(rise.max()), max(OVER_NOISE * usual, LEAST_STEP)
    if largest < needed:
        raise DataError(
            f"no flash: its largest step of brightness is {largest:.4f}, needed {needed:.4f} of full range."
        )
    found = []
    for i in np.flatnonzero(rise >= max(needed, OF_LARGEST * largest)):
        if rise[i] < rise[max(i - 1, 0) : i + 2].max() or (i > 0 and rise[i - 1] == rise[i]):
            continue
        below, seen, above = levels[i : i + 3]
        found.append(float(times[i + 1]) + (1 - float(np.clip((seen - below) / (above - below), 0, 1))) * interval)
    return found


def flash_lag(first: list[float], second: list[float], *, interval: float) -> tuple[float, float]:
    """By how much the second film began later than the first, from the flashes that both saw.

    Returns:
        The difference of starts and the largest disagreement between flashes [s].
    """
    within = SAME * interval
    ways = []
    for lag in (a - b for a in first for b in second):
        nearest = [min((a - b for b in second), key=lambda apart: abs(apart - lag)) for a in first]
        ways.append([apart for apart in nearest if abs(apart - lag) <= within])
    most = max(len(way) for way in ways)
    lags = [float(np.mean(way)) for way in ways if len(way) == most]
    if np.ptp(lags) > within:
        raise DataError(
            f"the reference saw {len(first)} flashes, it saw {len(second)}, and they match in several ways (lags of "
            f"{min(lags):.3f} s to {max(lags):.3f} s). Cut the films so that both hold the same flashes."
        )
    best = next(way for way in ways if len(way) == most)
    return lags[0], float(np.ptp(best))
