"""Clusters keep their bound of the diameter, and do not depend on the order of the points."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import pdist

from gausim.ops.clustering import ball_clusters, k_means


def _count(labels: np.ndarray) -> int:
    return int(labels.max()) + 1


def _widest(points: np.ndarray, labels: np.ndarray) -> float:
    order = np.argsort(labels, kind="stable")
    members = np.split(points[order], np.flatnonzero(np.diff(labels[order])) + 1)
    return max((float(pdist(m).max()) for m in members if len(m) > 1), default=0.0)


def _cloud(count: int = 150, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)) * (1.0, 0.5, 2.0)


def test_every_cluster_keeps_the_diameter_bound(diameter: float = 0.8) -> None:
    points = _cloud()
    labels = ball_clusters(points, diameter)
    assert sorted(set(labels)) == list(range(labels.max() + 1))
    assert _count(labels) < len(points)  # else the bound says nothing
    assert _widest(points, labels) <= diameter * (1 + 1e-9)


def test_permuting_points_permutes_labels() -> None:
    points = _cloud()
    order = np.random.default_rng(1).permutation(len(points))
    assert np.array_equal(ball_clusters(points[order], 0.8), ball_clusters(points, 0.8)[order])


def test_separate_clumps_are_found() -> None:
    rng = np.random.default_rng(2)
    truth = np.repeat(np.arange(4), 6)
    points = np.array([[0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 5.0]])[truth] + rng.uniform(-0.1, 0.1, (24, 3))
    labels = ball_clusters(points, 1.0)
    assert labels.max() == 3 and ball_clusters(np.ones((1, 3)), 0.5).tolist() == [0]
    assert np.array_equal(labels[:, None] == labels, truth[:, None] == truth)


def test_k_means_finds_groups_and_is_a_fixed_point() -> None:
    generator = np.random.default_rng(0)
    middles = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4], [4, 4, 4]])
    points = np.concatenate([m + 0.3 * generator.standard_normal((30, 3)) for m in middles])
    centres = k_means(points, 5)
    groups = np.array([points[30 * i : 30 * (i + 1)].mean(0) for i in range(5)])
    nearest = np.linalg.norm(centres[:, None] - groups[None], axis=-1)
    assert sorted(nearest.argmin(1)) == list(range(5))
    assert nearest.min(1).max() < 1e-12  # each centre is the mean of the points nearest to it
    order = generator.permutation(len(points))
    assert np.allclose(np.sort(k_means(points[order], 5), axis=0), np.sort(centres, axis=0))
    assert np.array_equal(k_means(points[:4], 7), points[:4])
