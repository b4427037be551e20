"""Neighbour edges within a radius, for several disjoint objects at once, on the CPU or entirely on a GPU.

Distances are compared in float32: two points are neighbours if their squared distance in float32 is below the squared
radius, and of two points at the same distance the one with the lower index counts as nearer. Hence the search in a k-d
tree (:func:`batched_radius_edges`) and that by torch operations (:func:`neighbour_codes`) agree, ties included.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

NONE = torch.iinfo(torch.int64).max
SLACK = 1 + 1e-5  # factor on the tree's search radius; distances in float32, accurate to 3e-7, decide afterwards
TABLE_ELEMENTS = 1 << 24  # distances that neighbour_codes computes at a time: 128 MiB of int64 keys


def radius_edges(points: Float[Tensor, "N 3"], radius: float, max_neighbours: int) -> Int[Tensor, "2 E"]:
    """Edges (source, destination): every point receives from its nearest neighbours within ``radius`` [scene units].

    Sorted by destination, then source. Self edges are left out; at most ``max_neighbours`` per destination.

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

    ``offsets`` are the first point of each of the M members, then N. The search runs on the CPU; tensors of another
    device are copied there and back. :func:`neighbour_codes` avoids this synchronisation.

    Raises:
        ValueError: a position is NaN or infinite.
    """
    x = points.detach().to("cpu", torch.float32).numpy()
    starts = offsets.cpu().long().numpy()
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
    """Edges into every point from its ``most`` nearest below a squared distance, sorted by destination and source."""
    count, k = len(x), min(most, len(x) - 1)
    if k < 1:
        return torch.zeros(2, 0, dtype=torch.int64)
    tree, limit, asked = cKDTree(x.numpy()), SLACK * math.sqrt(square), min(count, k + 9)
    # The point itself is one of the k + 1 nearest; the query grows until it has all points tied with the last of them.
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
    """Squared lengths, written out so that rounding is the same in every search."""
    dx, dy, dz = offsets.unbind(-1)
    return dx * dx + dy * dy + dz * dz


def _first(
    squares: Float[Tensor, "R C"], near: Bool[Tensor, "R C"], index: Int[Tensor, "... C"], k: int
) -> Int[Tensor, "R k"]:
    """Ascending indices of the k nearest candidates of each row, padded with ``NONE``."""
    # The bits of a float32 >= 0 are ordered as the numbers are: one key combines the distance and, for ties, the index.
    key = (squares.view(torch.int32).long() << 32) | index
    found = key.masked_fill(~near, NONE).topk(k, largest=False, sorted=False).values
    return torch.where(found == NONE, NONE, found & 0xFFFFFFFF).sort().values


def neighbour_codes(
    points: Float[Tensor, "N 3"], member_of_point: Int[Tensor, " N"], radii: Float[Tensor, " M"], k: int
) -> Int[Tensor, " N_times_k"]:
    """The edges of :func:`batched_radius_edges` as N k codes (:func:`edge_codes`), from torch operations alone.

    Shapes do not depend on the positions and the host is not synchronised, so a CUDA graph can capture it. All N^2
    distances are computed, in blocks of rows; ``k`` is the cap of incoming edges per point.
    """
    x, count = points.detach().float(), len(points)
    squares = _squared(radii).index_select(0, member_of_point)
    identity = torch.arange(count, device=x.device)
    width = min(k, count)
    source = torch.full((count, k), count, device=x.device)
    for low in range(0, count, max(TABLE_ELEMENTS // max(count, 1), 1)):
        rows = slice(low, low + max(TABLE_ELEMENTS // max(count, 1), 1))
        square = _squares(x - x[rows, None])
        near = (square < squares[rows, None]) & (member_of_point[rows, None] == member_of_point)
        near &= identity[rows, None] != identity
        source[rows, :width] = _first(square, near, identity, width)
    edges = torch.stack((source, identity[:, None].expand_as(source))).flatten(1)
    return torch.where(edges[0] < count, edge_codes(edges, count), no_edge(count)).sort().values


def _squared(radii: Tensor) -> Tensor:
    return radii.double().square().float()


def edge_codes(edges: Int[Tensor, "2 E"], count: int) -> Int[Tensor, " E"]:
    """One number per edge (source, destination) over ``count`` nodes, ordered by destination, then source."""
    return edges[1] * (count + 1) + edges[0]


def coded_edges(codes: Int[Tensor, " E"], count: int) -> Int[Tensor, "2 E"]:
    """Edges from their codes, the inverse of :func:`edge_codes`."""
    return torch.stack((codes % (count + 1), codes // (count + 1)))


def no_edge(count: int) -> int:
    """The code that pads to a fixed number: an edge from a dummy node N to itself, larger than all others."""
    return count * (count + 2)


def combine_codes(a: Int[Tensor, " A"], b: Int[Tensor, " B"], count: int, *, rule: str) -> Int[Tensor, " A_and_B"]:
    """``union`` or ``intersection`` of two sets of edges over ``count`` nodes, as A + B ascending codes, padded.

    The codes of a set have no repetitions, except of :func:`no_edge`.
    """
    codes = torch.cat((a, b)).sort().values
    repeated = torch.zeros_like(codes, dtype=torch.bool)
    repeated[1:] = codes[1:] == codes[:-1]
    return codes.masked_fill(repeated if rule == "union" else ~repeated, no_edge(count)).sort().values
