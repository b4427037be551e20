"""Complete-linkage agglomeration cut at a diameter, on the pairs that are closer than it; compiled.

Two clusters may merge only if every cross pair is within the diameter, so pairs farther apart have no influence: the
nearest-neighbour chain (Benzecri 1982, Juan 1982; Murtagh 1983) on the sparse graph of close pairs gives the same
clusters as the full distance matrix, because complete linkage is reducible and a missing pair stays missing.
"""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numba
import numpy as np

from gausim.kernels.jit import HELPER, KERNEL
from gausim.kernels.kdtree import STACK, node_range

BRUTE_FORCE = 64  # pairs of points that are compared one by one rather than through their nodes' boxes


@numba.njit(**HELPER)
def _farthest_of_ranges(points, a_low, a_high, b_low, b_high):
    best = 0.0
    for i in range(a_low, a_high):
        x, y, z = points[0, i], points[1, i], points[2, i]
        for j in range(b_low, b_high):
            dx, dy, dz = points[0, j] - x, points[1, j] - y, points[2, j] - z
            best = max(best, dx * dx + dy * dy + dz * dz)
    return best


@numba.njit(**HELPER)
def _box_reach(boxes, a, b):
    """Squared distance of the farthest corners of two nodes' boxes."""
    total = 0.0
    for axis in range(3):
        d = max(boxes[a, 3 + axis] - boxes[b, axis], boxes[b, 3 + axis] - boxes[a, axis])
        total += d * d
    return total


@numba.njit(**HELPER)
def _farthest_of_nodes(depth, points, boxes, a, b, square, stack):
    """Squared distance of the farthest points of two nodes, by branch and bound, or any value above ``square``."""
    count = points.shape[1]
    best = 0.0
    stack[0, 0], stack[1, 0], top = a, b, 0
    while top >= 0 and best <= square:
        a, b = stack[0, top], stack[1, top]
        top -= 1
        if _box_reach(boxes, a, b) <= best:
            continue
        a_low, a_high = node_range(a, depth, count)
        b_low, b_high = node_range(b, depth, count)
        if (a_high - a_low) * (b_high - b_low) <= BRUTE_FORCE or (a >> depth and b >> depth):
            best = max(best, _farthest_of_ranges(points, a_low, a_high, b_low, b_high))
            continue
        if b >> depth or (not a >> depth and a_high - a_low >= b_high - b_low):
            first_a, first_b, second_a, second_b = 2 * a, b, 2 * a + 1, b
        else:
            first_a, first_b, second_a, second_b = a, 2 * b, a, 2 * b + 1
        if _box_reach(boxes, first_a, first_b) > _box_reach(boxes, second_a, second_b):
            first_a, first_b, second_a, second_b = second_a, second_b, first_a, first_b
        stack[0, top + 1], stack[1, top + 1] = first_a, first_b
        stack[0, top + 2], stack[1, top + 2] = second_a, second_b
        top += 2
    return best


@numba.njit(**KERNEL)
def cross_squares(depth, points, boxes, ends, nodes, pairs, square):
    """Squared distance of the farthest points of each pair of groups (see ``kdtree.compact_nodes``).

    Where it exceeds ``square``, some value above that.
    """
    reach = np.empty((2, 2), np.int64)
    stack = np.empty((2, STACK), np.int64)
    squares = np.empty(pairs.shape[1])
    for p in range(pairs.shape[1]):
        for side in range(2):
            group = pairs[side, p]
            reach[side, 0], reach[side, 1] = ends[group], ends[group + 1]
        a, b = nodes[pairs[0, p]], nodes[pairs[1, p]]
        work = (reach[0, 1] - reach[0, 0]) * (reach[1, 1] - reach[1, 0])
        if work > BRUTE_FORCE and a > 0 and b > 0:
            squares[p] = _farthest_of_nodes(depth, points, boxes, a, b, square, stack)
        else:
            squares[p] = _farthest_of_ranges(points, reach[0, 0], reach[0, 1], reach[1, 0], reach[1, 1])
    return squares


@numba.njit(**HELPER)
def _rows(count, pairs, squares, square):
    """Adjacency of the pairs within ``square``: starts, sizes, neighbours, squared distances, twins.

    The twin of an entry is the position of the same pair in the row of the other unit.
    """
    sizes = np.zeros(count, np.int64)
    for p in range(pairs.shape[1]):
        if squares[p] <= square:
            sizes[pairs[0, p]] += 1
            sizes[pairs[1, p]] += 1
    starts = np.zeros(count + 1, np.int64)
    starts[1:] = np.cumsum(sizes)
    neighbours, twins = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    weights = np.empty(starts[-1])
    sizes[:] = 0
    for p in range(pairs.shape[1]):
        if squares[p] <= square:
            i, j = pairs[0, p], pairs[1, p]
            at, to = starts[i] + sizes[i], starts[j] + sizes[j]
            neighbours[at], neighbours[to] = j, i
            weights[at] = weights[to] = squares[p]
            twins[at], twins[to] = to, at
            sizes[i] += 1
            sizes[j] += 1
    return starts, sizes, neighbours, weights, twins


@numba.njit(**HELPER)
def _remove(row, at, starts, sizes, neighbours, weights, twins):
    """Removes an entry; the last one of the row takes its place."""
    sizes[row] -= 1
    last = starts[row] + sizes[row]
    if at != last:
        neighbours[at], weights[at], twins[at] = neighbours[last], weights[last], twins[last]
        twins[twins[at]] = at


@numba.njit(**HELPER)
def _merge(keep, gone, marks, starts, sizes, neighbours, weights, twins):
    """Complete linkage: the union is as far from a third as the farther of the two, and close only if both are."""
    for at in range(starts[gone], starts[gone] + sizes[gone]):
        marks[neighbours[at]] = weights[at]
        _remove(neighbours[at], twins[at], starts, sizes, neighbours, weights, twins)
    for at in range(starts[keep] + sizes[keep] - 1, starts[keep] - 1, -1):
        third = neighbours[at]
        if marks[third] < 0:
            _remove(third, twins[at], starts, sizes, neighbours, weights, twins)
            _remove(keep, at, starts, sizes, neighbours, weights, twins)
        elif marks[third] > weights[at]:
            weights[at] = weights[twins[at]] = marks[third]
    for at in range(starts[gone], starts[gone] + sizes[gone]):
        marks[neighbours[at]] = -1.0
    sizes[gone] = 0


@numba.njit(**KERNEL)
def complete_linkage(count, pairs, squares, square):
    """Clusters ``count`` units so that no pair of a cluster is farther apart than sqrt(``square``).

    ``pairs`` (2, p) are all pairs that may be within the bound, once, in either order, ``squares`` (p,) their
    squared distances. Returns the number of one unit of the cluster for every unit, (count,).
    """
    starts, sizes, neighbours, weights, twins = _rows(count, pairs, squares, square)
    into = np.arange(count)
    marks = np.full(count, -1.0)
    chain = np.empty(count + 1, np.int64)
    for seed in range(count):
        chain[0], length = seed, 1
        while length:
            tip = chain[length - 1]
            if not sizes[tip]:
                break  # farther than the bound from all others; this happens only to the first of a chain
            nearest, before = -1, chain[length - 2] if length > 1 else -1
            weight = np.inf
            for at in range(starts[tip], starts[tip] + sizes[tip]):
                other = neighbours[at]
                if weights[at] < weight or (
                    weights[at] == weight and nearest != before and (other == before or other < nearest)
                ):
                    nearest, weight = other, weights[at]
            if nearest != before:
                chain[length] = nearest
                length += 1
                continue
            into[before] = tip
            _merge(tip, before, marks, starts, sizes, neighbours, weights, twins)
            length -= 2
            if not length:
                chain[0], length = tip, 1
    for i in range(count):
        last = i
        while into[last] != last:
            into[last] = into[into[last]]
            last = into[last]
        into[i] = last
    return into
