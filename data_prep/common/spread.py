"""Even coverings: points of a surface that are far from each other, directions of a dome."""

from __future__ import annotations

import heapq
import math

import numpy as np
from scipy.spatial import cKDTree

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def farthest(points: np.ndarray, count: int, first: int = 0) -> np.ndarray:
    """Indices of at most ``count`` points (N, 3): each next one is the farthest from all chosen ones.

    A new point is nearer only to points within the largest distance, so that the cost of one falls with their number.
    """
    tree, chosen = cKDTree(points), [first]
    distance = ((points - points[first]) ** 2).sum(1)
    heap = list(zip((-distance).tolist(), range(len(points)), strict=True))
    heapq.heapify(heap)
    while len(chosen) < count:
        while -heap[0][0] != distance[heap[0][1]]:  # an entry of an earlier distance
            heapq.heappop(heap)
        largest, index = -heap[0][0], heap[0][1]
        if largest == 0:
            break
        chosen.append(index)
        near = np.array(tree.query_ball_point(points[index], math.sqrt(largest) * (1 + 1e-9)))
        now = ((points[near] - points[index]) ** 2).sum(1)
        nearer = now < distance[near]
        distance[near[nearer]] = now[nearer]
        for entry in zip((-now[nearer]).tolist(), near[nearer].tolist(), strict=True):
            heapq.heappush(heap, entry)
    return np.array(chosen)


def dome(count: int, highest: float) -> list[tuple[float, float]]:
    """Azimuth and elevation [radian] of directions spread evenly from level to ``highest`` [degree]."""
    top = math.sin(math.radians(highest))
    return [(i * GOLDEN_ANGLE, math.asin((i + 0.5) / count * top)) for i in range(count)]
