"""Neighbour edges within a radius."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor


def radius_edges(points: Float[Tensor, "N 3"], radius: float, max_neighbours: int) -> Int[Tensor, "2 E"]:
    """Edges (source, destination): every point receives from its nearest neighbours within ``radius``.

    Sorted by destination, then source. Self edges are left out; at most ``max_neighbours`` per destination.

    Args:
        points: positions [scene units].
        radius: largest edge length [scene units].
        max_neighbours: cap of incoming edges per point.
    """
    x = points.detach().cpu().double().numpy()
    k = min(max_neighbours + 1, len(x))
    distance, source = cKDTree(x).query(x, k=k, distance_upper_bound=radius)
    distance, source = distance.reshape(len(x), k), source.reshape(len(x), k)
    destination = np.broadcast_to(np.arange(len(x))[:, None], source.shape)
    keep = np.isfinite(distance) & (source != destination)
    # A point that coincides with others may not find itself among its nearest: cap again.
    keep &= np.cumsum(keep, 1) <= max_neighbours
    s, d = source[keep], destination[keep]
    order = np.lexsort((s, d))
    return torch.from_numpy(np.stack((s[order], d[order])).astype(np.int64)).to(points.device)


def combine_edges(a: Int[Tensor, "2 E1"], b: Int[Tensor, "2 E2"], count: int, *, rule: str) -> Int[Tensor, "2 E3"]:
    """Union or intersection of two edge sets over ``count`` nodes, sorted by destination, then source."""
    codes = [e[1] * count + e[0] for e in (a, b)]
    if rule == "union":
        code = torch.unique(torch.cat(codes))
    elif rule == "intersection":
        code = torch.sort(codes[0][torch.isin(codes[0], codes[1])]).values
    else:
        raise ValueError(f"edge rule is {rule!r}; expected 'union' or 'intersection'")
    return torch.stack((code % count, code // count))
