"""Neighbour edges within a radius: for several disjoint objects at once, on the CPU and without leaving a GPU.

Everything here measures in float32: two points are neighbours if their squared distance, in float32, is below the
squared radius, and of two points at the same distance the one with the lower index is nearer. So the search in a k-d
tree (:func:`batched_radius_edges`) and the one of torch operations (:func:`neighbour_table`) agree to the last tie.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

NONE = torch.iinfo(torch.int64).max
SLACK = 1 + 1e-5  # of distances in the tree, where those of float32 decide, which are good to 3e-7
TABLE_ELEMENTS = 1 << 24  # distances that neighbour_table holds at a time: 128 MiB of int64 keys


def radius_edges(points: Float[Tensor, "N 3"], radius: float, max_neighbours: int) -> Int[Tensor, "2 E"]:
    """Edges (source, destination): every point receives from its nearest neighbours within ``radius``.

    Sorted by destination, then source. Self edges are left out; at most ``max_neighbours`` per destination.

    Args:
        points: positions [scene units].
        radius: edges are shorter than this [scene units].
        max_neighbours: cap of incoming edges per point.

    Raises:
        ValueError: a position is NaN or infinite.
    """
    return batched_radius_edges(
        points, torch.tensor([0, len(points)]), torch.tensor([radius], dtype=torch.float64), max_neighbours
    )


def batched_radius_edges(
    points: Float[Tensor, "N 3"],
    offsets: Int[Tensor, " members_and_end"],
    radii: Float[Tensor, " M"],
    max_neighbours: int,
) -> Int[Tensor, "2 E"]:
    """:func:`radius_edges` of every member of a disjoint union, with indices into the union.

    The search runs on the CPU; tensors of another device are copied there and back. Nothing there waits for the
    host with :func:`neighbour_table`.

    Args:
        points: positions of all members, one member after the other [scene units].
        offsets: first point of each of the M members, then N.
        radii: per member, edges are shorter than this [scene units].
        max_neighbours: cap of incoming edges per point.

    Raises:
        ValueError: a position is NaN or infinite, or the offsets do not run from 0 to N.
    """
    x = points.detach().to("cpu", torch.float32).numpy()
    starts = offsets.cpu().long().numpy()
    if len(starts) != len(radii) + 1 or starts[0] != 0 or starts[-1] != len(x) or (np.diff(starts) < 0).any():
        raise ValueError(
            f"offsets are {starts.tolist()}; expected {len(radii) + 1} ascending numbers from 0 to {len(x)} points"
        )
    if not np.isfinite(x).all():
        raise ValueError(
            f"{int((~np.isfinite(x).all(1)).sum())} of {len(x)} positions are NaN or infinite, so they have no "
            "neighbours: the state has diverged. Lower the learning rate or shorten the rollout."
        )
    edges = [torch.zeros(2, 0, dtype=torch.int64)]
    for low, end, square in zip(starts[:-1], starts[1:], _squared(radii).tolist(), strict=True):
        edges.append(low + _nearest(torch.from_numpy(x[low:end]), square, max_neighbours))
    return torch.cat(edges, 1).to(points.device)


def _nearest(x: Float[Tensor, "N 3"], square: float, most: int) -> Int[Tensor, "2 E"]:
    """Edges into every point from the at most ``most`` nearest below a squared distance, by destination and source."""
    count, k = len(x), min(most, len(x) - 1)
    if k < 1:
        return torch.zeros(2, 0, dtype=torch.int64)
    tree, limit, asked = cKDTree(x.numpy()), SLACK * math.sqrt(square), min(count, k + 9)
    # The point itself is one of the k + 1 nearest; more are asked for until none is as far as the last that counts.
    distance, found = tree.query(x.numpy(), asked, distance_upper_bound=limit)
    while asked < count and (distance[:, -1] <= SLACK * np.minimum(distance[:, k], limit)).any():
        asked = min(count, 2 * asked)
        distance, found = tree.query(x.numpy(), asked, distance_upper_bound=limit)
    index, own = torch.from_numpy(found), torch.arange(count)[:, None]
    squares = _squares(x[index.clamp_max(count - 1)] - x[:, None])
    index = _first(squares, (squares < square) & (index < count) & (index != own), index, k)
    valid = index < count
    return torch.stack((index[valid], own.expand_as(index)[valid]))


def _squares(offsets: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N"]:
    """Written out, so that every product and sum is rounded alike in every search."""
    dx, dy, dz = offsets.unbind(-1)
    return dx * dx + dy * dy + dz * dz


def _first(
    squares: Float[Tensor, "R C"], near: Bool[Tensor, "R C"], index: Int[Tensor, "... C"], k: int
) -> Int[Tensor, "R k"]:
    """The indices of the k nearest candidates of each row, ascending; larger than any index where there are none."""
    # The bits of a float32 >= 0 order as the number does: one key holds the distance and, for ties, the index.
    key = (squares.view(torch.int32).long() << 32) | index
    found = key.masked_fill(~near, NONE).topk(k, largest=False, sorted=False).values
    return torch.where(found == NONE, NONE, found & 0xFFFFFFFF).sort().values


def neighbour_table(
    points: Float[Tensor, "N 3"],
    member_of_point: Int[Tensor, " N"],
    radii: Float[Tensor, " M"],
    k: int,
) -> tuple[Int[Tensor, "N k"], Bool[Tensor, "N k"]]:
    """The edges of :func:`batched_radius_edges` as a table of fixed shape, from torch operations alone.

    No shape depends on the positions and nothing is read back to the host, so it can be captured in a CUDA graph.
    All N^2 distances are computed, some rows at a time.

    Args:
        points: positions of all members [scene units].
        member_of_point: which member each point belongs to; only points of one member are neighbours.
        radii: per member, edges are shorter than this [scene units].
        k: cap of incoming edges per point.

    Returns:
        index: sources of the edges into each point, ascending; entries that are not valid hold the point itself.
        valid: which entries are edges; the others follow them.
    """
    x, count = points.detach().float(), len(points)
    squares = _squared(radii).index_select(0, member_of_point)
    identity = torch.arange(count, device=x.device)
    width = min(k, count)
    nearest_index = torch.full((count, k), count, device=x.device)
    for low in range(0, count, max(TABLE_ELEMENTS // max(count, 1), 1)):
        rows = slice(low, low + max(TABLE_ELEMENTS // max(count, 1), 1))
        square = _squares(x - x[rows, None])
        near = (square < squares[rows, None]) & (member_of_point[rows, None] == member_of_point)
        near &= identity[rows, None] != identity
        nearest_index[rows, :width] = _first(square, near, identity, width)
    valid = nearest_index < count
    return torch.where(valid, nearest_index, identity[:, None]), valid


def _squared(radii: Tensor) -> Tensor:
    return radii.double().square().float()


def combine_edges(a: Int[Tensor, "2 E1"], b: Int[Tensor, "2 E2"], count: int, *, rule: str) -> Int[Tensor, "2 E3"]:
    """Union or intersection of two edge sets over ``count`` nodes, sorted by destination, then source.

    Args:
        a: edges (source, destination) sorted by destination, then source, without repeats.
        b: edges sorted likewise.
        count: number of nodes.
        rule: ``union`` or ``intersection``.

    Raises:
        ValueError: unknown rule.
    """
    if rule not in ("union", "intersection"):
        raise ValueError(f"edge rule is {rule!r}; expected 'union' or 'intersection'")
    codes = [e[1] * count + e[0] for e in (a, b)]
    code = torch.unique(torch.cat(codes)) if rule == "union" else codes[0][torch.isin(codes[0], codes[1])]
    return torch.stack((code % count, code // count))


def combine_tables(
    a: tuple[Int[Tensor, "N k1"], Bool[Tensor, "N k1"]],
    b: tuple[Int[Tensor, "N k2"], Bool[Tensor, "N k2"]],
    *,
    rule: str,
) -> tuple[Int[Tensor, "N k"], Bool[Tensor, "N k"]]:
    """:func:`combine_edges` of two tables (:func:`neighbour_table`); shapes depend on the tables' shapes alone.

    Returns:
        The union as a table of k = k1 + k2 columns, the intersection as one of k = k1, sorted like its arguments.

    Raises:
        ValueError: unknown rule.
    """
    (index, valid), (other, other_valid) = a, b
    count = len(index)
    shared = ((index[:, :, None] == other[:, None, :]) & valid[:, :, None] & other_valid[:, None, :]).any(2)
    if rule == "union":
        index, valid = torch.cat((index, other), 1), torch.cat((valid & ~shared, other_valid), 1)
    elif rule == "intersection":
        valid = shared
    else:
        raise ValueError(f"edge rule is {rule!r}; expected 'union' or 'intersection'")
    index = torch.where(valid, index, count).sort(1).values
    valid = index < count
    return torch.where(valid, index, torch.arange(count, device=index.device)[:, None]), valid
