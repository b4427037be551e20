"""Even coverings: points of a surface that are far from each other, directions of a dome."""

from __future__ import annotations

import math

import numpy as np

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def farthest(points: np.ndarray, count: int, first: int = 0) -> np.ndarray:
    """Indices of at most ``count`` points (N, 3): each next one is the farthest from all chosen ones."""
    chosen, distance = [first], np.full(len(points), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(1))
        if distance.max() == 0:
            break
        chosen.append(int(distance.argmax()))
    return np.array(chosen)


def dome(count: int, highest: float) -> list[tuple[float, float]]:
    """Azimuth and elevation [radian] of directions spread evenly from level to ``highest`` [degree]."""
    top = math.sin(math.radians(highest))
    return [(i * GOLDEN_ANGLE, math.asin((i + 0.5) / count * top)) for i in range(count)]
