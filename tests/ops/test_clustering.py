"""Clusters keep their bound of the diameter; near-linear complete linkage is exact where all pairs fit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import pdist

from gausim.ops import clustering
from gausim.ops.clustering import CLUSTERINGS, agglomerative_clusters, k_means


def _count(labels: np.ndarray) -> int:
    return int(labels.max()) + 1


def _widest(points: np.ndarray, labels: np.ndarray) -> float:
    order = np.argsort(labels, kind="stable")
    members = np.split(points[order], np.flatnonzero(np.diff(labels[order])) + 1)
    return max((float(pdist(m).max()) for m in members if len(m) > 1), default=0.0)


def _cloud(count: int = 150, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)) * (1.0, 0.5, 2.0)


@pytest.mark.parametrize("name", CLUSTERINGS)
def test_every_cluster_keeps_the_diameter_bound(name: str, diameter: float = 0.8) -> None:
    points = _cloud()
    labels = CLUSTERINGS[name](points, diameter)
    assert sorted(set(labels)) == list(range(labels.max() + 1))
    assert _count(labels) < len(points)  # else the bound says nothing
    assert _widest(points, labels) <= diameter * (1 + 1e-9)


@pytest.mark.parametrize("name", CLUSTERINGS)
def test_permuting_points_permutes_labels(name: str) -> None:
    points = _cloud()
    order = np.random.default_rng(1).permutation(len(points))
    assert np.array_equal(CLUSTERINGS[name](points[order], 0.8), CLUSTERINGS[name](points, 0.8)[order])


@pytest.mark.parametrize("name", CLUSTERINGS)
def test_separate_clumps_are_found_whatever_the_method(name: str) -> None:
    rng = np.random.default_rng(2)
    truth = np.repeat(np.arange(4), 6)
    points = np.array([[0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 5.0]])[truth] + rng.uniform(-0.1, 0.1, (24, 3))
    labels = CLUSTERINGS[name](points, 1.0)
    assert labels.max() == 3 and CLUSTERINGS[name](np.ones((1, 3)), 0.5).tolist() == [0]
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


def _cube(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((count, 3))


def _sphere(count: int) -> np.ndarray:
    x = np.random.default_rng(1).normal(size=(count, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


@pytest.mark.parametrize(("seed", "diameter"), [(0, 0.05), (1, 0.2), (2, 0.6), (3, 2.0)])
def test_equals_complete_linkage_of_all_pairs(seed: int, diameter: float) -> None:
    points = _cube(200, seed) * (1.0, 0.4, 1.7)
    expected = fcluster(linkage(points, "complete"), diameter, "distance")
    found = agglomerative_clusters(points, diameter)
    assert np.array_equal(found[:, None] == found, expected[:, None] == expected)


@pytest.mark.parametrize(("points", "diameter"), [(_cube(2_000), 0.12), (_sphere(2_000), 0.5)], ids=["cube", "sphere"])
def test_groups_keep_the_bound_and_about_as_many_clusters(monkeypatch, points, diameter) -> None:
    monkeypatch.setattr(clustering, "MAX_PAIRS", 4_000)  # so few pairs fit that points are merged into groups first
    labels = agglomerative_clusters(points, diameter)
    assert 0.7 * diameter < _widest(points, labels) <= diameter * (1 + 1e-12)
    assert _count(labels) == pytest.approx(fcluster(linkage(points, "complete"), diameter, "distance").max(), rel=0.25)


def test_a_grid_full_of_ties_keeps_the_bound_and_the_equivariance() -> None:
    points = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), -1).reshape(-1, 3)
    labels = agglomerative_clusters(points, 2.0)
    assert _widest(points, labels) <= 2.0 and _count(labels) < len(points) / 3
    order = np.random.default_rng(0).permutation(len(points))
    assert np.array_equal(agglomerative_clusters(points[order], 2.0), labels[order])


@pytest.mark.parametrize("pairs", [8_000_000, 1_000])
def test_points_on_a_line_and_clumps_that_coincide(monkeypatch: pytest.MonkeyPatch, pairs: int) -> None:
    monkeypatch.setattr(clustering, "MAX_PAIRS", pairs)
    line = np.linspace(0, 1, 400)[:, None] * (1.0, 2.0, -2.0)
    labels = agglomerative_clusters(line, 0.5)
    assert _widest(line, labels) <= 0.5 * (1 + 1e-12) and 6 <= _count(labels) <= 12
    assert (np.diff(labels) >= 0).all()  # intervals, numbered along the line
    clumps = np.repeat(_cube(5) * 10, 300, axis=0)
    assert np.array_equal(agglomerative_clusters(clumps, 0.1)[::300], np.argsort(np.argsort(clumps[::300, 0])))
