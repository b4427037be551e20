"""Clusters of bounded diameter, against complete linkage by scipy."""

from __future__ import annotations

from functools import partial
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage

from benchmarks.harness import Options, Row, medians
from gausim.ops.clustering import ball_clusters

DIAMETER = 0.04  # [fraction of the diagonal]: 23,422 kernels make about the paper's 1,203 units
LINKAGE_LIMIT = 12_000  # points; complete linkage of more takes gigabytes
SIZES = {False: (2_000, 12_000, 23_422, 1_000_000), True: (200, 600)}


def run(options: Options) -> list[Row]:
    """Time and number of clusters of points in a thin bumpy shell, similar to a reconstruction's kernels."""
    rows = []
    for count in SIZES[options.quick]:
        points, case, scipy = _shell(count), f"{count} kernels", "complete linkage (scipy)"
        time = medians({"": partial(ball_clusters, points, DIAMETER)}, options, warmup=0)[""]
        clusters = int(ball_clusters(points, DIAMETER).max()) + 1
        rows += [Row(case, "time", time, "s"), Row(case, "clusters", clusters, "1")]
        if count <= LINKAGE_LIMIT:
            start = perf_counter()
            reference = int(fcluster(linkage(points, "complete"), DIAMETER, "distance").max())
            rows.append(Row(case, "time ratio", time / (perf_counter() - start), "x", scipy))
            rows.append(Row(case, "clusters ratio", clusters / reference, "x", scipy))
    return rows


def _shell(count: int) -> NDArray[np.float64]:
    """Points (count, 3) in a bumpy spherical shell of radius 1 and thickness 0.02, scaled to the diagonal 1."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(count, 3, generator=generator)
    x = x / x.norm(dim=1, keepdim=True)
    x = x * (1 + 0.15 * torch.sin(5 * x).prod(1, keepdim=True) + 0.02 * torch.rand(count, 1, generator=generator))
    shell: NDArray[np.float64] = (x / (x.amax(0) - x.amin(0)).norm()).double().numpy()
    return shell
