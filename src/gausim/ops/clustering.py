"""Clustering of kernels into units of bounded diameter (METHOD section 1), and k-means."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

LLOYD_ITERATIONS = 8


def _canonical_order(points: np.ndarray) -> np.ndarray:
    """Lexicographic order of the positions, by which results are equivariant to permutations of the kernels."""
    return np.lexsort((points[:, 2], points[:, 1], points[:, 0]))


def _relabel(points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Numbers the clusters 0.. by the canonical order of their first members."""
    order = _canonical_order(points)
    _, first, inverse = np.unique(labels[order], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    result = np.empty(len(points), np.int64)
    result[order] = rank[inverse]
    return result


def ball_clusters(points: Float[np.ndarray, "N 3"], diameter: float) -> Int[np.ndarray, " N"]:
    """Near-linear clustering: every member lies within ``diameter`` / 2 of its cluster's centre.

    A greedy ball cover seeds the centres; Lloyd iterations then move each centre to its members' mean unless a member
    would leave the ball, so the diameter bound holds by construction.

    Args:
        points: positions [scene units].
        diameter: largest allowed distance between two members [scene units].
    """
    radius = diameter / 2
    tree = cKDTree(points)
    labels = np.full(len(points), -1, np.int64)
    centres: list[np.ndarray] = []
    for i in _canonical_order(points):
        if labels[i] < 0:
            near = np.asarray(tree.query_ball_point(points[i], radius * (1 - 1e-9)))
            labels[near[labels[near] < 0]] = len(centres)
            centres.append(points[i])
    seeds = np.asarray(centres)
    for _ in range(LLOYD_ITERATIONS):
        distance, nearest = cKDTree(seeds).query(points)
        inside = distance <= radius
        labels = np.where(inside, nearest, labels)
        used, labels = np.unique(labels, return_inverse=True)
        seeds = seeds[used]
        sums = np.stack([np.bincount(labels, points[:, d], len(used)) for d in range(3)], 1)
        means = sums / np.bincount(labels, minlength=len(used))[:, None]
        reach = np.zeros(len(used))
        np.maximum.at(reach, labels, np.linalg.norm(points - means[labels], axis=1))
        seeds = np.where((reach <= radius)[:, None], means, seeds)
    return _relabel(points, labels)


def k_means(points: Float[np.ndarray, "N 3"], count: int) -> Float[np.ndarray, "count 3"]:
    """Centres of ``count`` >= 1 clusters by Lloyd's iterations, initialised by farthest-point sampling.

    If the count is not below the number of points, the points are returned in order.
    """
    if count >= len(points):
        return np.array(points, np.float64)
    chosen = np.empty(count, np.int64)
    chosen[0] = _canonical_order(points)[0]
    distance = np.full(len(points), np.inf)
    for i in range(1, count):
        distance = np.minimum(distance, np.square(points - points[chosen[i - 1]]).sum(1))
        chosen[i] = distance.argmax()
    centres = points[chosen].astype(np.float64)
    for _ in range(LLOYD_ITERATIONS):
        _, nearest = cKDTree(centres).query(points)
        size = np.bincount(nearest, minlength=count)
        sums = np.stack([np.bincount(nearest, points[:, d], count) for d in range(3)], 1)
        centres = np.where(size[:, None] > 0, sums / np.maximum(size, 1)[:, None], centres)
    return centres
