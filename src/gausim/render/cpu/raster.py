"""Compositing of one band's tiles, and its adjoint: the two hot loops.

A tile is 8 x 16 pixels, eight blocks of two rows. The kernels of a tile are distributed to its blocks, each of which is
composited with the state of its sixteen pixels in vector registers. Validity is decided on the exponent, because the
polynomial is invalid outside its range. ``depth`` is an image or None; numba compiles both cases separately, so that
images without depth cost no more. ``records`` are those of projection.py, flattened.
"""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"
from __future__ import annotations

import numba
import numpy as np

from gausim.kernels.jit import HELPER, KERNEL
from gausim.render.cpu.binning import TILE_HEIGHT, TILE_WIDTH
from gausim.render.cpu.projection import RECORD
from gausim.render.cpu.simd import (
    LANES,
    column_centres,
    folded,
    largest,
    load,
    maximum,
    minimum,
    row_centres,
    select,
    splat,
    spread,
    store,
)

PIXELS = TILE_WIDTH * TILE_HEIGHT
BLOCKS = PIXELS // LANES
SUMS = LANES  # per kernel; their positions are projection.S .. S_DEPTH
T_STOP = np.float32(1e-4)  # a kernel that would leave less transmittance than this ends its pixel (3DGS)
CHECK_EVERY = 8  # kernels between two checks whether a pixel of the block is still open
CHUNK = 128  # kernels of a tile that are distributed to its blocks at a time

# e^u = p(u)^8 with p the minimax polynomial of e^(u) on [-0.7, 0]; relative error 6e-7 after the eighth power.
P0, P1, P2 = np.float32(0.999999921), np.float32(0.999992539), np.float32(0.499882588)
P3, P4, P5 = np.float32(0.165973976), np.float32(0.0397725622), np.float32(0.0058467601)
ZERO, ONE = np.float32(0), np.float32(1)
# Without reassociation: offsets from a pixel stay exact far from the image's origin only in the order written.
ORDER = {"contract", "arcp", "nsz", "afn", "nnan", "ninf"}


@numba.njit(fastmath=ORDER, **HELPER)
def distribute(entries, begin, end, lists, stride, counts):
    """Lists for each block of a tile the kernels of the entries ``begin .. end - 1`` that touch it, near to far.

    List p starts at ``lists[p * stride]`` and gets ``counts[p]`` rows. Every entry is written to every list, but only
    counted where it belongs: a branch would be mispredicted half of the time.
    """
    for p in range(BLOCKS):
        counts[p] = p * stride
    for e in range(begin, end):
        packed = entries[e]
        g = packed >> 8
        bits = (2 << (packed & 15)) - (1 << ((packed >> 4) & 15))
        for p in range(BLOCKS):
            lists[counts[p]] = g
            counts[p] += (bits >> p) & 1
    for p in range(BLOCKS):
        counts[p] -= p * stride


@numba.njit(fastmath=ORDER, **HELPER)
def opacity(records, at, x, y):
    """Opacity times e^u of the kernel with its record at ``at`` in sixteen pixels, and where it is at least 1/255."""
    dx = (x - spread(records, at)) - spread(records, at + 1)
    dy = (y - spread(records, at + 2)) - spread(records, at + 3)
    u = dy * spread(records, at + 6) + dx * spread(records, at + 5)
    u = dy * u + dx * dx * spread(records, at + 4)
    p = P0 + u * (P1 + u * (P2 + u * (P3 + u * (P4 + u * P5))))
    p = p * p
    p = p * p
    p = p * p
    return p * spread(records, at + 7), u >= spread(records, at + 11)


@numba.njit(fastmath=ORDER, **HELPER)
def forward_block(records, rows, begin, end, done, x, y, alpha_max, buf, at, depth):
    """Composites the kernels ``rows[begin:end]``, after ``done`` others, over sixteen pixels with the centres x, y.

    Their state is ``buf[at:]`` = [T | final | last | R | G | B | D]. T continues to fall after a pixel is closed (a
    product never grows, so it stays closed); final is T and last the number of the last kernel before the closing.

    Returns:
        One past the last kernel that was read: the block ends early when all its pixels are closed.
    """
    t, final, last = load(buf, at), load(buf, at + LANES), load(buf, at + 2 * LANES)
    red, green, blue = load(buf, at + 3 * LANES), load(buf, at + 4 * LANES), load(buf, at + 5 * LANES)
    far, i = load(buf, at + 6 * LANES), begin
    while i < end and largest(t) > T_STOP:
        stop = min(i + CHECK_EVERY, end)
        while i < stop:
            record = RECORD * rows[i]
            raw, inside = opacity(records, record, x, y)
            w = t * select(inside, minimum(raw, alpha_max), ZERO)
            t = t - w
            keep = t > T_STOP
            w = select(keep, w, ZERO)
            if depth is not None:
                far += w * spread(records, record + 12)
            final, last = select(keep, t, final), select(keep, splat(np.float32(done + i - begin)), last)
            red += w * spread(records, record + 8)
            green += w * spread(records, record + 9)
            blue += w * spread(records, record + 10)
            i += 1
    store(buf, at, t)
    store(buf, at + LANES, final)
    store(buf, at + 2 * LANES, last)
    store(buf, at + 3 * LANES, red)
    store(buf, at + 4 * LANES, green)
    store(buf, at + 5 * LANES, blue)
    store(buf, at + 6 * LANES, far)
    return i


@numba.njit(fastmath=ORDER, **HELPER)
def forward_tile(records, entries, begin, end, left, top, alpha_max, buf, lists, counts, used, depth):
    """Composites the entries ``begin .. end - 1`` over the blocks of a tile, into their states in ``buf``.

    ``used`` (BLOCKS + 1,) receives the number of kernels of its list that each block read, and one past the last entry
    that was distributed.
    """
    used[BLOCKS] = end
    for p in range(BLOCKS):
        at = 7 * LANES * p
        store(buf, at, splat(ONE))
        store(buf, at + LANES, splat(ONE))
        store(buf, at + 2 * LANES, splat(-ONE))
        for j in range(3, 7):
            store(buf, at + j * LANES, splat(ZERO))
        used[p] = 0
    for first in range(begin, end, CHUNK):
        distribute(entries, first, min(first + CHUNK, end), lists, CHUNK, counts)
        open_ = splat(ZERO)
        for p in range(BLOCKS):
            x, y = column_centres() + left, row_centres() + (top + np.float32(2 * p))
            at, base = 7 * LANES * p, CHUNK * p
            seen = forward_block(records, lists, base, base + counts[p], used[p], x, y, alpha_max, buf, at, depth)
            used[p] += seen - base
            open_ = maximum(open_, load(buf, at))
        if largest(open_) <= T_STOP:
            used[BLOCKS] = min(first + CHUNK, end)
            return


@numba.njit(fastmath=ORDER, **HELPER)
def backward_block(records, rows, begin, end, x, y, alpha_max, buf, sums, depth):
    """Adds the sums of the kernels ``rows[begin:end]`` over sixteen pixels to ``sums`` (rows * SUMS).

    ``buf`` = [T | last | vr | vg | vb | vd | behind]. Runs back to front: ``behind`` is the derivative B with respect
    to the transmittance behind the current kernel, by the recursion B <- B + alpha (d - B) with d = v . colour of the
    kernel; T is the transmittance in front of it.
    """
    t, last, behind = load(buf, 0), load(buf, LANES), load(buf, 6 * LANES)
    vr, vg, vb, vd = load(buf, 2 * LANES), load(buf, 3 * LANES), load(buf, 4 * LANES), load(buf, 5 * LANES)
    for i in range(end - 1, begin - 1, -1):
        record = RECORD * rows[i]
        raw, inside = opacity(records, record, x, y)
        alpha = select(inside & (last >= np.float32(i - begin)), minimum(raw, alpha_max), ZERO)
        t = t * (ONE / (ONE - alpha))
        shown = vr * spread(records, record + 8)
        shown += vg * spread(records, record + 9)
        shown += vb * spread(records, record + 10)
        if depth is not None:
            shown += vd * spread(records, record + 12)
        gap = shown - behind
        # At its ceiling alpha does not depend on the exponent.
        s, w = select(raw <= alpha_max, alpha, ZERO) * t * gap, alpha * t
        behind = behind + alpha * gap
        add_sums(records, rows[i], x, y, vr, vg, vb, vd, s, w, sums, depth)


@numba.njit(fastmath=ORDER, **HELPER)
def add_sums(records, g, x, y, vr, vg, vb, vd, s, w, sums, depth):
    """Adds the sums over sixteen pixels to row g; both rows of pixels have the same dx and are added first."""
    at = g * RECORD
    dx = (x - spread(records, at)) - spread(records, at + 1)
    dy = (y - spread(records, at + 2)) - spread(records, at + 3)
    sy = s * dy
    both = folded(s, sy, 8)  # [s | s dy], eight columns each
    cross = both * dx
    one = folded(both, cross, 4)
    two = folded(cross * dx, folded(sy * dy, w * vb, 8), 4)
    if depth is not None:
        three = folded(folded(w * vr, w * vg, 8), folded(w * vd, splat(ZERO), 8), 4)
    else:
        three = folded(folded(w * vr, w * vg, 8), splat(ZERO), 4)
    total = folded(folded(one, two, 2), folded(three, splat(ZERO), 2), 1)
    store(sums, g * SUMS, load(sums, g * SUMS) + total)


@numba.njit(fastmath=ORDER, **HELPER)
def write_block(buf, at, x, y, background, rgb, alpha, depth):
    """Writes sixteen finished pixels from (y, x) on, without those beyond the image's edge."""
    through = load(buf, at + LANES)
    for c in range(3):
        store(buf, at + (3 + c) * LANES, load(buf, at + (3 + c) * LANES) + through * background[c])
    height, width = alpha.shape
    for row in range(min(2, height - y)):
        for column in range(min(TILE_WIDTH, width - x)):
            i = at + row * TILE_WIDTH + column
            for c in range(3):
                rgb[y + row, x + column, c] = buf[i + (3 + c) * LANES]
            alpha[y + row, x + column] = ONE - buf[i + LANES]
            if depth is not None:
                depth[y + row, x + column] = buf[i + 6 * LANES]


@numba.njit(fastmath=ORDER, **HELPER)
def read_block(grad_rgb, grad_alpha, grad_depth, x, y, buf):
    """Fills [vr | vg | vb | vd | v alpha] of ``buf`` with the loss gradients of sixteen pixels, 0 beyond the edge."""
    height, width = grad_alpha.shape
    for j in range(2, 7):
        store(buf, j * LANES, splat(ZERO))
    for row in range(min(2, height - y)):
        for column in range(min(TILE_WIDTH, width - x)):
            i = row * TILE_WIDTH + column
            for c in range(3):
                buf[(2 + c) * LANES + i] = grad_rgb[y + row, x + column, c]
            if grad_depth is not None:
                buf[5 * LANES + i] = grad_depth[y + row, x + column]
            buf[6 * LANES + i] = grad_alpha[y + row, x + column]


@numba.njit(fastmath=ORDER, **KERNEL)
def forward_band(records, entries, start, row_low, background, alpha_max, rgb, alpha, depth, final, last, used):
    """Draws one band into ``rgb`` (H, W, 3), ``alpha`` (H, W) and, unless it is None, ``depth`` (H, W).

    ``final`` and ``last`` (tiles, PIXELS) receive the remaining transmittance and the number of the last kernel that
    contributed, ``used`` (tiles, BLOCKS + 1) the numbers of entries read (forward_tile).
    """
    strips = (alpha.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    flat, buf = records.reshape(-1), np.empty(7 * PIXELS, np.float32)
    lists, counts = np.empty(BLOCKS * CHUNK + 1, np.int32), np.empty(BLOCKS, np.int64)
    for tile in range(start.shape[0] - 1):
        top, left = row_low + tile // strips * TILE_HEIGHT, tile % strips * TILE_WIDTH
        forward_tile(
            flat, entries, start[tile], start[tile + 1], np.float32(left), np.float32(top), alpha_max, buf, lists,
            counts, used[tile], depth,
        )  # fmt: skip
        for p in range(BLOCKS):
            at = 7 * LANES * p
            store(final[tile], p * LANES, load(buf, at + LANES))
            store(last[tile], p * LANES, load(buf, at + 2 * LANES))
            write_block(buf, at, left, top + 2 * p, background, rgb, alpha, depth)


@numba.njit(fastmath=ORDER, **KERNEL)
def backward_band(
    records, entries, start, row_low, background, alpha_max, grad_rgb, grad_alpha, grad_depth, final, last, used, sums,
    behind,
):  # fmt: skip
    """Adjoint of :func:`forward_band`: writes the band's ``sums`` (rows, SUMS).

    ``grad_depth`` is None without depth; ``behind`` (3,), float64 or None, receives the background's loss gradient.
    """
    strips = (grad_alpha.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    flat, buf = sums.reshape(-1), np.zeros(7 * LANES, np.float32)
    flat_records = records.reshape(-1)
    flat[:] = ZERO
    most = 0  # entries of a tile
    for tile in range(start.shape[0] - 1):
        most = max(most, used[tile, BLOCKS] - start[tile])
    lists, counts = np.empty(BLOCKS * most + 1, np.int32), np.empty(BLOCKS, np.int64)
    for tile in range(start.shape[0] - 1):
        if behind is None and used[tile, BLOCKS] == start[tile]:
            continue
        top, left = row_low + tile // strips * TILE_HEIGHT, tile % strips * TILE_WIDTH
        distribute(entries, start[tile], used[tile, BLOCKS], lists, most, counts)
        for p in range(BLOCKS):
            if behind is None and used[tile, p] == 0:
                continue
            read_block(grad_rgb, grad_alpha, grad_depth, left, top + 2 * p, buf)
            red, green, blue = load(buf, 2 * LANES), load(buf, 3 * LANES), load(buf, 4 * LANES)
            store(buf, 0, load(final[tile], p * LANES))
            store(buf, LANES, load(last[tile], p * LANES))
            shown = red * background[0] + green * background[1] + blue * background[2] - load(buf, 6 * LANES)
            store(buf, 6 * LANES, shown)
            if behind is not None:
                for i in range(LANES):
                    for c in range(3):
                        behind[c] += final[tile, p * LANES + i] * buf[(2 + c) * LANES + i]
            x, y = column_centres() + np.float32(left), row_centres() + np.float32(top + 2 * p)
            first, end = p * most, p * most + used[tile, p]
            backward_block(flat_records, lists, first, end, x, y, alpha_max, buf, flat, grad_depth)
