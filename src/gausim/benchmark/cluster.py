"""Benchmark: clusters of bounded diameter and neighbour search, against scipy in the same run."""

from __future__ import annotations

import time

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist
from torch import Tensor

from gausim.benchmark.harness import Options, Row, medians
from gausim.ops.clustering import agglomerative_clusters, ball_clusters, complete_linkage_clusters
from gausim.ops.neighbours import batched_radius_edges, combine_edges, neighbour_table, radius_edges

DIAMETER = 0.04  # [fraction of the diagonal]: 23,422 kernels make about the paper's 1,203 systems
LINKAGE_LIMIT = 12_000  # points; complete linkage of more takes gigabytes
BALL_LIMIT = 50_000  # points; its loop over centres takes too long beyond
NEIGHBOURS = 16
MEMBERS = 4
SIZES = {False: (2_000, 12_000, 23_422, 1_000_000), True: (500, 1_500)}
# Points and graph radius [fraction of the diagonal] of level 1 at the paper's size, and of the kernels themselves.
GRAPHS = {False: ((1_203, 0.4), (23_422, 0.1)), True: ((300, 0.4),)}


def run(options: Options) -> list[Row]:
    """Clusters and neighbours of points spread over a thin bumpy shell, as a reconstruction's kernels are."""
    rows = []
    agglomerative_clusters(_shell(100).double().numpy(), 0.5)  # compiles, so that no row counts it
    for count in SIZES[options.quick]:
        rows += _clusters(count, options)
    for count, radius in GRAPHS[options.quick]:
        rows += _neighbours(count, radius, options)
        rows += _batch(count, radius, options)
        if options.device.type == "cuda":
            rows += _table(count, radius, options)
    return rows


def _shell(count: int) -> Tensor:
    """Points (count, 3) around a sphere of radius 1 with bumps, 0.02 thick, with the diagonal 1."""
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
    reference = None
    if count <= LINKAGE_LIMIT:
        start = time.perf_counter()
        reference = int(complete_linkage_clusters(points, DIAMETER).max()) + 1
        times["complete linkage"] = time.perf_counter() - start
    rows = []
    for name, found in labels.items():
        case = f"{name}, {count} kernels"
        clusters = int(found.max()) + 1
        rows.append(Row(case, "time", times[name], "s"))
        rows.append(Row(case, "throughput", count / times[name], "kernels/s"))
        rows.append(Row(case, "clusters", clusters, "1"))
        rows.append(Row(case, "widest cluster", _widest(points, found) / DIAMETER, "x", "the bound"))
        if reference is not None:
            text = "complete linkage (scipy)"
            rows.append(Row(case, "clusters ratio", clusters / reference, "x", text))
            rows.append(Row(case, "time ratio", times[name] / times["complete linkage"], "x", text))
    return rows


def _widest(points: np.ndarray, labels: np.ndarray) -> float:
    order = np.argsort(labels, kind="stable")
    members = np.split(points[order], np.flatnonzero(np.diff(labels[order])) + 1)
    return max((float(pdist(m).max()) for m in members if len(m) > 1), default=0.0)


def _neighbours(count: int, radius: float, options: Options) -> list[Row]:
    points = _shell(count)
    array = points.double().numpy()
    moved = points + 0.003 * torch.randn(points.shape, generator=torch.Generator().manual_seed(1))
    rest, now = (radius_edges(x, radius, NEIGHBOURS) for x in (points, moved))

    def unique() -> Tensor:
        return torch.unique(torch.cat([e[1] * count + e[0] for e in (rest, now)]))

    times = medians(
        {
            "search": lambda: radius_edges(points, radius, NEIGHBOURS),
            "scipy": lambda: cKDTree(array).query(array, NEIGHBOURS + 1, distance_upper_bound=radius),
            "union": lambda: combine_edges(rest, now, count, rule="union"),
            "unique": unique,
        },
        options,
    )
    case = f"neighbours, {count} points"
    return [
        Row(case, "time", times["search"], "s"),
        Row(case, "time ratio", times["search"] / times["scipy"], "x", "cKDTree, build and query, no edges made"),
        Row(f"union of edges, {count} points", "time", times["union"], "s"),
        Row(f"union of edges, {count} points", "time ratio", times["union"] / times["unique"], "x", "torch.unique"),
    ]


def _batch(count: int, radius: float, options: Options) -> list[Row]:
    """Several members in one call against as many calls."""
    points = _shell(count).repeat(MEMBERS, 1)
    offsets, radii = count * torch.arange(MEMBERS + 1), torch.full((MEMBERS,), radius)

    def one_by_one() -> list[Tensor]:
        return [radius_edges(part, radius, NEIGHBOURS) for part in points.split(count)]

    times = medians(
        {"batched": lambda: batched_radius_edges(points, offsets, radii, NEIGHBOURS), "loop": one_by_one}, options
    )
    case = f"neighbours, {MEMBERS} x {count} points"
    return [
        Row(case, "time", times["batched"], "s"),
        Row(case, "time ratio", times["batched"] / times["loop"], "x", f"{MEMBERS} calls"),
    ]


def _table(count: int, radius: float, options: Options) -> list[Row]:
    """The search that stays on the device against the one that goes through the host."""
    points = _shell(count).to(options.device)
    member = torch.zeros(count, dtype=torch.int64, device=options.device)
    radii = torch.full((1,), radius, device=options.device)
    times = medians(
        {
            "table": lambda: neighbour_table(points, member, radii, NEIGHBOURS),
            "host": lambda: radius_edges(points, radius, NEIGHBOURS),
        },
        options,
    )
    case = f"neighbour table on {options.device.type}, {count} points"
    return [
        Row(case, "time", times["table"], "s"),
        Row(case, "time ratio", times["table"] / times["host"], "x", "the compiled search, through the host"),
    ]
