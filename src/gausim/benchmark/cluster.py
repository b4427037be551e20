"""Benchmark of clustering with bounded diameter, against scipy in the same run."""

from __future__ import annotations

import time

import numpy as np
import torch
from scipy.spatial.distance import pdist
from torch import Tensor

from gausim.benchmark.harness import Options, Row, medians
from gausim.ops.clustering import agglomerative_clusters, ball_clusters, complete_linkage_clusters

DIAMETER = 0.04  # [fraction of the diagonal]: 23,422 kernels make about the paper's 1,203 systems
LINKAGE_LIMIT = 12_000  # points; complete linkage of more takes gigabytes
BALL_LIMIT = 50_000  # points; its loop over centres takes too long beyond
SIZES = {False: (2_000, 12_000, 23_422, 1_000_000), True: (200, 600)}


def run(options: Options) -> list[Row]:
    """Clusters of points in a thin bumpy shell, similar to a reconstruction's kernels."""
    rows = []
    agglomerative_clusters(_shell(100).double().numpy(), 0.5)  # compiles before the timing
    for count in SIZES[options.quick]:
        rows += _clusters(count, options)
    return rows


def _shell(count: int) -> Tensor:
    """Points (count, 3) in a bumpy spherical shell of radius 1 and thickness 0.02, scaled to the diagonal 1."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(count, 3, generator=generator)
    x = x / x.norm(dim=1, keepdim=True)
    bumps = 1 + 0.15 * torch.sin(5 * x).prod(1, keepdim=True) + 0.02 * torch.rand(count, 1, generator=generator)
    x = x * bumps
    return x / (x.amax(0) - x.amin(0)).norm()


def _clusters(count: int, options: Options) -> list[Row]:
    points = _shell(count).double().numpy()
    candidates = {"agglomerative": lambda: agglomerative_clusters(points, DIAMETER)}
    if count <= BALL_LIMIT:
        candidates["ball"] = lambda: ball_clusters(points, DIAMETER)
    times = medians(candidates, options, rounds=min(options.rounds, 3), warmup=0)
    labels = {name: call() for name, call in candidates.items()}
    reference, linkage = None, 0.0
    if count <= LINKAGE_LIMIT:
        start = time.perf_counter()
        reference = int(complete_linkage_clusters(points, DIAMETER).max()) + 1
        linkage = time.perf_counter() - start
    rows = []
    for name, found in labels.items():
        case, clusters = f"{name}, {count} kernels", int(found.max()) + 1
        rows += [
            Row(case, "time", times[name], "s"),
            Row(case, "throughput", count / times[name], "kernels/s"),
            Row(case, "clusters", clusters, "1"),
            Row(case, "widest cluster", _widest(points, found) / DIAMETER, "x", "the bound"),
        ]
        if reference is not None:
            text = "complete linkage (scipy)"
            rows.append(Row(case, "clusters ratio", clusters / reference, "x", text))
            rows.append(Row(case, "time ratio", times[name] / linkage, "x", text))
    return rows


def _widest(points: np.ndarray, labels: np.ndarray) -> float:
    order = np.argsort(labels, kind="stable")
    members = np.split(points[order], np.flatnonzero(np.diff(labels[order])) + 1)
    return max((float(pdist(m).max()) for m in members if len(m) > 1), default=0.0)
