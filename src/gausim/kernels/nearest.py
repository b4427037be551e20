"""Nearest neighbours of every point of several disjoint sets, and merging of sorted edges; compiled."""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import math

import numba
import numpy as np

from gausim.kernels.jit import HELPER, KERNEL
from gausim.kernels.kdtree import STACK, build

LEAF = 20  # points in a leaf; 8 to 24 cost the same within 3 %


@numba.njit(**HELPER)
def _bits(square):
    """The bit pattern of a float32 >= 0; it orders as the number does."""
    return np.int64(np.float32(square).view(np.int32))


@numba.njit(**HELPER)
def _gap(boxes, node, x, y, z):
    """Squared distance from a point to a node's box; never above that of a point inside, rounding included."""
    zero = x - x
    dx = max(boxes[node, 0] - x, x - boxes[node, 3], zero)
    dy = max(boxes[node, 1] - y, y - boxes[node, 4], zero)
    dz = max(boxes[node, 2] - z, z - boxes[node, 5], zero)
    return np.float32(dx * dx + dy * dy + dz * dz)


@numba.njit(**HELPER)
def _scan(points, order, low, high, query, best):
    """Inserts the points of a leaf into ``best`` (k,): ascending keys (float32 squared distance, index)."""
    x, y, z = points[0, query], points[1, query], points[2, query]
    last = best.shape[0] - 1
    for i in range(low, high):
        dx, dy, dz = points[0, i] - x, points[1, i] - y, points[2, i] - z
        key = (_bits(dx * dx + dy * dy + dz * dz) << 32) | order[i]
        if key < best[last] and i != query:
            at = last
            while at > 0 and best[at - 1] > key:
                best[at] = best[at - 1]
                at -= 1
            best[at] = key


@numba.njit(**HELPER)
def _search(depth, points, order, boxes, query, leaf, best, stack, gaps):
    """Nearest points of ``query``, which lies in ``leaf``: its own leaf first, then the siblings on the way up."""
    count = points.shape[1]
    x, y, z = points[0, query], points[1, query], points[2, query]
    low, high = (leaf * count) >> depth, ((leaf + 1) * count) >> depth
    _scan(points, order, low, high, query, best)
    path = (1 << depth) + leaf
    while path > 1:
        stack[0], gaps[0], top = path ^ 1, _gap(boxes, path ^ 1, x, y, z), 0
        while top >= 0:
            node, gap = stack[top], gaps[top]
            top -= 1
            if _bits(gap) > best[-1] >> 32:
                continue
            if node >> depth:
                j = node - (1 << depth)
                _scan(points, order, (j * count) >> depth, ((j + 1) * count) >> depth, query, best)
                continue
            left, right = _gap(boxes, 2 * node, x, y, z), _gap(boxes, 2 * node + 1, x, y, z)
            nearer = 1 if right < left else 0
            stack[top + 1], gaps[top + 1] = 2 * node + 1 - nearer, max(left, right)
            stack[top + 2], gaps[top + 2] = 2 * node + nearer, min(left, right)
            top += 2
        path >>= 1


@numba.njit(**HELPER)
def _write_ascending(best, limit, chosen, row):
    """Writes the indices of the keys below ``limit`` to ``row`` in ascending order (by rank: no branches)."""
    found = 0
    while found < best.shape[0] and best[found] < limit:
        chosen[found] = np.int32(best[found] & 0x7FFFFFFF)
        found += 1
    for i in range(found):
        rank = 0
        for j in range(found):
            rank += chosen[j] < chosen[i]
        row[rank] = chosen[i]
    return found


@numba.njit(**HELPER)
def _search_limit(points, query, reach, bound):
    """A key above those of the k nearest points of ``query``: ``bound``, or nearer where that is known.

    Triangle inequality: the k neighbours of the point before, within ``reach`` of it, and that point itself are no
    farther away than ``reach`` and the distance to it together.
    """
    if reach < 0:
        return bound
    moved = 0.0
    for a in range(3):
        moved += float(points[a, query] - points[a, query - 1]) ** 2
    far = (math.sqrt(moved) + reach) * (1 + 1e-5)  # float32 squares are good to 3e-7
    return min(bound, (_bits(far * far) + 1) << 32)


@numba.njit(**HELPER)
def _member(points, square, table, counts):
    """Fills ``table`` (n, k) with the neighbours of one member's points (3, n), ``counts`` (n,) with their number."""
    count, k = table.shape
    depth, order, sorted_points, boxes = build(points, LEAF)
    best, chosen = np.empty(k, np.int64), np.empty(k, np.int32)
    stack, gaps = np.empty(STACK, np.int32), np.empty(STACK, np.float32)
    bound = _bits(square) << 32
    reach = -1.0
    for leaf in range(1 << depth):
        for query in range((leaf * count) >> depth, ((leaf + 1) * count) >> depth):
            limit = _search_limit(sorted_points, query, reach, bound)
            best[:] = limit
            _search(depth, sorted_points, order, boxes, query, leaf, best, stack, gaps)
            reach = -1.0
            if best[k - 1] < limit:
                reach = math.sqrt(np.int32(best[k - 1] >> 32).view(np.float32))
            counts[order[query]] = _write_ascending(best, limit, chosen, table[order[query]])


@numba.njit(**KERNEL)
def member_edges(points, starts, squares, k):
    """Edges (source, destination) from the at most k nearest points below a distance, within each member.

    Args:
        points: (3, N) float32, finite; member m holds starts[m] : starts[m + 1].
        starts: (M + 1,).
        squares: (M,) float32, the squared distances that edges stay below.
        k: >= 1.

    Returns:
        edges (2, E) int64, sorted by destination, then source. Of two equally distant points the one with the lower
        index is nearer.
    """
    count = points.shape[1]
    table, counts = np.empty((count, k), np.int32), np.empty(count, np.int32)
    for m in range(len(starts) - 1):
        low, high = starts[m], starts[m + 1]
        if high > low:
            _member(points[:, low:high].copy(), squares[m], table[low:high], counts[low:high])
    edges = np.empty((2, counts.sum()), np.int64)
    at = 0
    for m in range(len(starts) - 1):
        for i in range(starts[m], starts[m + 1]):
            for j in range(counts[i]):
                edges[0, at], edges[1, at] = starts[m] + table[i, j], i
                at += 1
    return edges


@numba.njit(**KERNEL)
def merge_edges(a, b, union):
    """Union or intersection of two edge sets (2, E) sorted by destination, then source.

    Returns:
        the merged edges, and whether both sets were in order without repeats.
    """
    merged = np.empty((2, a.shape[1] + b.shape[1] if union else min(a.shape[1], b.shape[1])), np.int64)
    i, j, found = 0, 0, 0
    last = np.array((-1, -1))
    while i < a.shape[1] or j < b.shape[1]:
        order = 0  # of the next edge of a and that of b
        if j == b.shape[1]:
            order = -1
        elif i == a.shape[1]:
            order = 1
        else:
            order = np.sign(a[1, i] - b[1, j])
            if order == 0:
                order = np.sign(a[0, i] - b[0, j])
        source, destination = (a[0, i], a[1, i]) if order <= 0 else (b[0, j], b[1, j])
        if destination < last[1] or (destination == last[1] and source <= last[0]):
            return merged[:, :found], False
        last[0], last[1] = source, destination
        i += order <= 0
        j += order >= 0
        if union or order == 0:
            merged[0, found], merged[1, found] = source, destination
            found += 1
    return merged[:, :found], True
