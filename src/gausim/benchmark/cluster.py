"""Benchmark of clustering with bounded diameter, against scipy in the same run."""

from __future__ import annotations

import time

import torch
from torch import Tensor

from gausim.benchmark.harness import Options, Row, medians
from gausim.ops.clustering import agglomerative_clusters, complete_linkage_clusters

DIAMETER = 0.04  # [fraction of the diagonal]: 23,422 kernels make about the paper's 1,203 systems
LINKAGE_LIMIT = 12_000  # points; complete linkage of more takes gigabytes
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
    points, case, scipy = _shell(count).double().numpy(), f"{count} kernels", "complete linkage (scipy)"
    candidates = {"own": lambda: agglomerative_clusters(points, DIAMETER)}
    times = medians(candidates, options, rounds=min(options.rounds, 3), warmup=0)
    clusters = int(candidates["own"]().max()) + 1
    rows = [Row(case, "time", times["own"], "s"), Row(case, "clusters", clusters, "1")]
    if count <= LINKAGE_LIMIT:
        start = time.perf_counter()
        reference = int(complete_linkage_clusters(points, DIAMETER).max()) + 1
        rows.append(Row(case, "time ratio", times["own"] / (time.perf_counter() - start), "x", scipy))
        rows.append(Row(case, "clusters ratio", clusters / reference, "x", scipy))
    return rows
