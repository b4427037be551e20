"""A balanced k-d tree with bounding boxes, compiled, for the clustering."""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numba
import numpy as np

from gausim.kernels.jit import HELPER, KERNEL

# numba compiles constants and called functions into its cached code and checks only the file of the caller for changes:
# after changing a name that other files import from here, delete their cache (__pycache__/*.nb?).
STACK = 96  # entries of a traversal's stack: more than twice the depth of any tree that fits in memory


@numba.njit(**HELPER)
def _split(values, order, low, high, middle):
    """Quickselect (Hoare): afterwards no value of order[low:middle] exceeds one of order[middle:high]."""
    left, right = low, high - 1
    while left < right:
        pivot = values[order[(left + right) >> 1]]
        i, j = left, right
        while i <= j:
            while values[order[i]] < pivot:
                i += 1
            while values[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            right = j
        elif middle >= i:
            left = i
        else:
            return


@numba.njit(**KERNEL)
def build(points, leaf):
    """Builds the tree of ``points`` (3, n), n >= 1, with at most ``leaf`` >= 2 points in a leaf.

    Node 1 is the root and node i has the children 2 i and 2 i + 1. Node 2^l + j of level l holds the points
    order[j n >> l : (j + 1) n >> l]; the leaves are the nodes of level ``depth``.

    Returns:
        depth; order (n,) int32; the points in that order (3, n); boxes (2^(depth + 1), 6), lower then upper corner.
    """
    count = points.shape[1]
    depth = 0
    while count > leaf << depth:
        depth += 1
    order = np.arange(count).astype(np.int32)
    boxes = np.empty((2 << depth, 6), points.dtype)
    for level in range(depth + 1):
        for j in range(1 << level):
            low, high = (j * count) >> level, ((j + 1) * count) >> level
            node, axis = (1 << level) + j, 0
            for a in range(3):
                least = most = points[a, order[low]]
                for i in range(low + 1, high):
                    least, most = min(least, points[a, order[i]]), max(most, points[a, order[i]])
                boxes[node, a], boxes[node, 3 + a] = least, most
                if most - least > boxes[node, 3 + axis] - boxes[node, axis]:
                    axis = a
            if level < depth:
                _split(points[axis], order, low, high, ((2 * j + 1) * count) >> (level + 1))
    ordered = np.empty_like(points)
    for a in range(3):
        for i in range(count):
            ordered[a, i] = points[a, order[i]]
    return depth, order, ordered, boxes


@numba.njit(**HELPER)
def node_range(node, depth, count):
    """First and one past the last point (in tree order) of a node."""
    level = 0
    while (node >> (level + 1)) > 0:
        level += 1
    j = node - (1 << level)
    return (j * count) >> level, ((j + 1) * count) >> level


@numba.njit(**HELPER)
def _box_gap(boxes, node, leaf):
    """Squared distance between the boxes of two nodes of one tree."""
    total = 0.0
    for a in range(3):
        d = max(boxes[node, a] - boxes[leaf, 3 + a], boxes[leaf, a] - boxes[node, 3 + a], 0.0)
        total += d * d
    return total


@numba.njit(**KERNEL)
def close_pairs(depth, points, boxes, square, capacity):
    """All pairs i < j (in tree order) of points (3, n) in float64 whose squared distance is at most ``square``.

    Returns:
        pairs (2, p) int32 and whether all of them fitted into ``capacity``.
    """
    count = points.shape[1]
    pairs = np.empty((2, capacity), np.int32)  # the system provides memory only as it is written
    stack = np.empty(STACK, np.int32)
    found = 0
    for leaf in range(1 << depth):
        low, high = (leaf * count) >> depth, ((leaf + 1) * count) >> depth
        stack[0], top = 1, 0
        while top >= 0:
            node = stack[top]
            top -= 1
            if _box_gap(boxes, node, (1 << depth) + leaf) > square:
                continue
            if not node >> depth:
                stack[top + 1], stack[top + 2] = 2 * node, 2 * node + 1
                top += 2
                continue
            other = node - (1 << depth)
            if other < leaf:
                continue
            end = ((other + 1) * count) >> depth
            if found + (high - low) * (high - low + end) > capacity + (high - low) * ((other * count) >> depth):
                return pairs[:, :found], False
            for i in range(low, high):
                for j in range(max(i + 1, (other * count) >> depth), end):
                    dx, dy, dz = points[0, j] - points[0, i], points[1, j] - points[1, i], points[2, j] - points[2, i]
                    pairs[0, found], pairs[1, found] = i, j
                    found += dx * dx + dy * dy + dz * dz <= square
    return pairs[:, :found], True


@numba.njit(**KERNEL)
def compact_nodes(depth, count, boxes, diagonal):
    """The largest nodes whose box diagonal is at most ``diagonal``, and the single points of leaves that exceed it.

    Returns:
        ends (g + 1,): group i holds the points ends[i] : ends[i + 1] in tree order.
        nodes (g,): its node, or 0 for a single point.
    """
    ends, nodes = np.zeros(count + 1, np.int64), np.zeros(count, np.int32)
    stack = np.empty(STACK, np.int32)
    stack[0], top, found = 1, 0, 0
    while top >= 0:
        node = stack[top]
        top -= 1
        total = 0.0
        for a in range(3):
            total += (boxes[node, 3 + a] - boxes[node, a]) ** 2
        if total <= diagonal * diagonal:
            ends[found + 1] = node_range(node, depth, count)[1]
            nodes[found] = node
            found += 1
        elif node >> depth:
            low, high = node_range(node, depth, count)
            for i in range(low, high):
                ends[found + 1] = i + 1
                found += 1
        else:
            stack[top + 1], stack[top + 2] = 2 * node + 1, 2 * node
            top += 2
    return ends[: found + 1], nodes[:found]
