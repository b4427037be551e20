"""Compositing of one band's tiles, and its adjoint: the two hot loops.

A tile is 8 x 16 pixels, eight blocks of two rows. The kernels of a tile are handed out to its blocks, and each block is
composited with all that is known of its sixteen pixels in vector registers, four kernels side by side. Validity is
decided on the exponent: the polynomial is meaningless outside its range. ``depth`` is an image or None; numba compiles
the two cases apart, so that images without depth do not pay for it. ``records`` are those of projection.py in one row.
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
    four_times,
    largest,
    load,
    load_colours,
    load_rows,
    maximum,
    minimum,
    numbers_of,
    part,
    row_centres,
    select,
    splat,
    spread,
    spread_four,
    store,
    store_colours,
    store_rows,
)

PIXELS = TILE_WIDTH * TILE_HEIGHT
BLOCKS = PIXELS // LANES
SUMS = LANES  # per kernel; projection.S .. S_DEPTH say which is where
T_STOP = np.float32(1e-4)  # a kernel that would leave less transmittance than this ends its pixel (3DGS)
CHECK_EVERY = 8  # kernels between two looks at whether any pixel of the block is still open
AT_ONCE = 16  # kernels between compositing and summation on the way back
CHUNK = 128  # kernels of a tile that are handed out to its blocks at a time

# e^u = p(u)^8 with p the minimax polynomial of e^(u) on [-0.7, 0]; relative error 6e-7 after the eighth power.
P0, P1, P2 = np.float32(0.999999921), np.float32(0.999992539), np.float32(0.499882588)
P3, P4, P5 = np.float32(0.165973976), np.float32(0.0397725622), np.float32(0.0058467601)
ZERO, ONE = np.float32(0), np.float32(1)
# Without reassociation: offsets from a pixel stay exact far from the image's origin only in the order written.
ORDER = {"contract", "arcp", "nsz", "afn", "nnan", "ninf"}

# Arithmetic per pixel and kernel, a fused multiply-add counted as two; comparisons, selections, loads and stores not at
# all. For the share of the machine's peak in ``gausim benchmark render``.
EXPONENTIAL = 1 + 1 + 1 + 2 + 4 + 10 + 3 + 1  # dx, dy, B dx, A dx dx, u, p, p^8, o p
FORWARD_FLOPS = EXPONENTIAL + 2 + 6  # w = t alpha and t - w, three colours
# t / (1 - alpha), w, gap, behind, s; five products with dx and dy, three with v, nine additions
BACKWARD_FLOPS = EXPONENTIAL + 2 + 1 + 6 + 2 + 1 + 5 + 3 + 9


@numba.njit(fastmath=ORDER, **HELPER)
def hand_out(entries, begin, end, lists, stride, counts, nobody):
    """Lists for each block of a tile those of the entries ``begin .. end - 1`` that reach it, near to far.

    List p starts at ``lists[p * stride]`` and gets ``counts[p]`` rows, followed by ``nobody`` to the next multiple of
    four. Every entry is written to every list and counts where it belongs: branches would be guessed wrong half of the
    time.
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
        for i in range(counts[p], counts[p] + 3):
            lists[i] = nobody
        counts[p] -= p * stride


@numba.njit(fastmath=ORDER, **HELPER)
def four_rows(rows, i):
    """Where the records of the kernels ``rows[i:i + 4]`` start."""
    return RECORD * rows[i], RECORD * rows[i + 1], RECORD * rows[i + 2], RECORD * rows[i + 3]


@numba.njit(fastmath=ORDER, **HELPER)
def opacities(records, four, x, y):
    """Of four kernels at sixteen pixels: the opacity o e^u and whether it is at least 1/255, side by side."""
    dx = (four_times(x) - spread_four(records, four, 0)) - spread_four(records, four, 1)
    dy = (four_times(y) - spread_four(records, four, 2)) - spread_four(records, four, 3)
    u = dy * spread_four(records, four, 6) + dx * spread_four(records, four, 5)
    u = dy * u + dx * dx * spread_four(records, four, 4)
    p = P0 + u * (P1 + u * (P2 + u * (P3 + u * (P4 + u * P5))))
    p = p * p
    p = p * p
    p = p * p
    return p * spread_four(records, four, 7), u >= spread_four(records, four, 11)


@numba.njit(fastmath=ORDER, **HELPER)
def over(pixels, records, at, alpha, number, depth):
    """The state of sixteen pixels (forward_block) after the kernel ``number``, whose record starts at ``at``."""
    t, final, last, red, green, blue, far = pixels
    w = t * alpha
    t = t - w
    keep = t > T_STOP
    w = select(keep, w, ZERO)
    if depth is not None:
        far += w * spread(records, at + 12)
    final, last = select(keep, t, final), select(keep, splat(np.float32(number)), last)
    red += w * spread(records, at + 8)
    green += w * spread(records, at + 9)
    blue += w * spread(records, at + 10)
    return t, final, last, red, green, blue, far


@numba.njit(fastmath=ORDER, **HELPER)
def forward_block(records, rows, begin, end, done, x, y, alpha_max, buf, at, depth):
    """Composites the kernels ``rows[begin:end]``, after ``done`` others, over sixteen pixels with the centres x, y.

    Their state is ``buf[at:]`` = [T | final | last | R | G | B | D]. T goes on falling where a pixel is closed (a
    product never grows, so it stays closed); final is T before that, last the
    number of the last kernel seen before that.

    Returns:
        One past the last kernel that was looked at: the block ends early when all its pixels are closed.
    """
    t, final, last = load(buf, at), load(buf, at + LANES), load(buf, at + 2 * LANES)
    red, green, blue = load(buf, at + 3 * LANES), load(buf, at + 4 * LANES), load(buf, at + 5 * LANES)
    far, i, final_number = load(buf, at + 6 * LANES), begin, done + end - begin - 1
    while i < end and largest(t) > T_STOP:
        stop = min(i + CHECK_EVERY, end)
        while i < stop:
            four = four_rows(rows, i)
            raw, inside = opacities(records, four, x, y)
            alpha = select(inside, minimum(raw, alpha_max), ZERO)
            pixels = t, final, last, red, green, blue, far
            # Beyond the end of the list stand kernels that touch nothing: they count as its last.
            number = done + i - begin
            pixels = over(pixels, records, four[0], part(alpha, 0), number, depth)
            pixels = over(pixels, records, four[1], part(alpha, 1), min(number + 1, final_number), depth)
            pixels = over(pixels, records, four[2], part(alpha, 2), min(number + 2, final_number), depth)
            pixels = over(pixels, records, four[3], part(alpha, 3), min(number + 3, final_number), depth)
            t, final, last, red, green, blue, far = pixels
            i += 4
    store(buf, at, t)
    store(buf, at + LANES, final)
    store(buf, at + 2 * LANES, last)
    store(buf, at + 3 * LANES, red)
    store(buf, at + 4 * LANES, green)
    store(buf, at + 5 * LANES, blue)
    store(buf, at + 6 * LANES, far)
    return min(i, end)


@numba.njit(fastmath=ORDER, **HELPER)
def forward_tile(records, entries, begin, end, left, top, alpha_max, buf, lists, counts, used, depth):
    """Composites the entries ``begin .. end - 1`` over the blocks of a tile, into their states in ``buf``.

    ``used`` (BLOCKS + 1,) receives how many kernels of its list each block looked at, and one past the last entry that
    was handed out.
    """
    used[BLOCKS], nobody = end, records.shape[0] // RECORD - 1
    for p in range(BLOCKS):
        at = 7 * LANES * p
        store(buf, at, splat(ONE))
        store(buf, at + LANES, splat(ONE))
        store(buf, at + 2 * LANES, splat(-ONE))
        for j in range(3, 7):
            store(buf, at + j * LANES, splat(ZERO))
        used[p] = 0
    for first in range(begin, end, CHUNK):
        hand_out(entries, first, min(first + CHUNK, end), lists, CHUNK + 3, counts, nobody)
        open_ = splat(ZERO)
        for p in range(BLOCKS):
            x, y = column_centres() + left, row_centres() + (top + np.float32(2 * p))
            at, base = 7 * LANES * p, (CHUNK + 3) * p
            seen = forward_block(records, lists, base, base + counts[p], used[p], x, y, alpha_max, buf, at, depth)
            used[p] += seen - base
            open_ = maximum(open_, load(buf, at))
        if largest(open_) <= T_STOP:
            used[BLOCKS] = min(first + CHUNK, end)
            return


@numba.njit(fastmath=ORDER, **HELPER)
def under(t, behind, kernel, work, at):
    """T and B in front of a kernel from those behind it; s and w go to ``work[at:]``.

    ``kernel`` = 1 / (1 - alpha), alpha, v . colour, and alpha where it is below its ceiling, else zero: there it does
    not depend on the exponent.
    """
    inverse, alpha, shown, free = kernel
    t = t * inverse
    gap = shown - behind
    store(work, at, free * t * gap)
    store(work, at + LANES, alpha * t)
    return t, behind + alpha * gap


@numba.njit(fastmath=ORDER, **HELPER)
def backward_block(records, rows, begin, end, x, y, alpha_max, buf, work, sums, depth):
    """Adds what the kernels ``rows[begin:end]`` do to sixteen pixels to ``sums`` (rows * SUMS).

    ``buf`` = [T | last | vr | vg | vb | vd | behind]. Runs back to front: ``behind`` is the derivative with respect to
    what lies behind the current kernel, by the recursion B <- B + alpha (d - B) with d = v . colour of the kernel; T is
    the transmittance in front of it. ``work`` takes s and w of AT_ONCE kernels from here to their summation.
    """
    t, last, behind = load(buf, 0), load(buf, LANES), load(buf, 6 * LANES)
    vr, vg, vb, vd = load(buf, 2 * LANES), load(buf, 3 * LANES), load(buf, 4 * LANES), load(buf, 5 * LANES)
    high = begin + (end - begin + 3) // 4 * 4
    while high > begin:
        low = max(begin, high - AT_ONCE)
        for i in range(high - 4, low - 4, -4):
            four = four_rows(rows, i)
            raw, inside = opacities(records, four, x, y)
            seen = four_times(last) >= numbers_of((i - begin, i - begin + 1, i - begin + 2, i - begin + 3))
            alpha = select(inside & seen, minimum(raw, alpha_max), ZERO)
            inverse = ONE / (ONE - alpha)
            shown = four_times(vr) * spread_four(records, four, 8)
            shown += four_times(vg) * spread_four(records, four, 9)
            shown += four_times(vb) * spread_four(records, four, 10)
            if depth is not None:
                shown += four_times(vd) * spread_four(records, four, 12)
            free, at = select(raw <= alpha_max, alpha, ZERO), 2 * LANES * (i - low)
            kernel = part(inverse, 3), part(alpha, 3), part(shown, 3), part(free, 3)
            t, behind = under(t, behind, kernel, work, at + 6 * LANES)
            kernel = part(inverse, 2), part(alpha, 2), part(shown, 2), part(free, 2)
            t, behind = under(t, behind, kernel, work, at + 4 * LANES)
            kernel = part(inverse, 1), part(alpha, 1), part(shown, 1), part(free, 1)
            t, behind = under(t, behind, kernel, work, at + 2 * LANES)
            kernel = part(inverse, 0), part(alpha, 0), part(shown, 0), part(free, 0)
            t, behind = under(t, behind, kernel, work, at)
        for i in range(low, high):
            add_sums(records, rows[i], x, y, vr, vg, vb, vd, work, (i - low) * 2 * LANES, sums, depth)
        high = low


@numba.njit(fastmath=ORDER, **HELPER)
def add_sums(records, g, x, y, vr, vg, vb, vd, work, at, sums, depth):
    """Adds the sums over sixteen pixels to row g; the two rows of pixels share dx, so theirs are taken first."""
    s, w = load(work, at), load(work, at + LANES)
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
    """Writes sixteen finished pixels from (y, x) on; those beyond the image's edge are left out."""
    through = load(buf, at + LANES)
    store(buf, at + 3 * LANES, load(buf, at + 3 * LANES) + through * background[0])
    store(buf, at + 4 * LANES, load(buf, at + 4 * LANES) + through * background[1])
    store(buf, at + 5 * LANES, load(buf, at + 5 * LANES) + through * background[2])
    height, width = alpha.shape
    if x + TILE_WIDTH <= width and y + 2 <= height:
        red, green, blue = load(buf, at + 3 * LANES), load(buf, at + 4 * LANES), load(buf, at + 5 * LANES)
        store_colours(rgb, y, x, red, green, blue)
        store_rows(alpha, y, x, ONE - through)
        if depth is not None:
            store_rows(depth, y, x, load(buf, at + 6 * LANES))
        return
    for i in range(LANES):
        row, column = y + i // TILE_WIDTH, x + i % TILE_WIDTH
        if row < height and column < width:
            for c in range(3):
                rgb[row, column, c] = buf[at + (3 + c) * LANES + i]
            alpha[row, column] = ONE - buf[at + LANES + i]
            if depth is not None:
                depth[row, column] = buf[at + 6 * LANES + i]


@numba.njit(fastmath=ORDER, **HELPER)
def read_block(grad_rgb, grad_alpha, grad_depth, x, y, buf):
    """Fills [vr | vg | vb | vd | v alpha] of ``buf`` with the gradients of sixteen pixels, zero beyond the edge."""
    height, width = grad_alpha.shape
    if x + TILE_WIDTH <= width and y + 2 <= height:
        red, green, blue = load_colours(grad_rgb, y, x)
        store(buf, 2 * LANES, red)
        store(buf, 3 * LANES, green)
        store(buf, 4 * LANES, blue)
        if grad_depth is not None:
            store(buf, 5 * LANES, load_rows(grad_depth, y, x))
        store(buf, 6 * LANES, load_rows(grad_alpha, y, x))
        return
    buf[2 * LANES :] = ZERO
    for i in range(LANES):
        row, column = y + i // TILE_WIDTH, x + i % TILE_WIDTH
        if row < height and column < width:
            for c in range(3):
                buf[(2 + c) * LANES + i] = grad_rgb[row, column, c]
            if grad_depth is not None:
                buf[5 * LANES + i] = grad_depth[row, column]
            buf[6 * LANES + i] = grad_alpha[row, column]


@numba.njit(fastmath=ORDER, **KERNEL)
def forward_band(records, entries, start, row_low, background, alpha_max, rgb, alpha, depth, final, last, used):
    """Draws one band into ``rgb`` (H, W, 3), ``alpha`` (H, W) and, unless it is None, ``depth`` (H, W).

    ``final`` and ``last`` (tiles, PIXELS) keep the remaining transmittance and the number of the last kernel
    that contributed; ``used``
    (tiles, BLOCKS + 1) how much of the entries was looked at (forward_tile).
    """
    strips = (alpha.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    flat, buf = records.reshape(-1), np.empty(7 * PIXELS, np.float32)
    lists, counts = np.empty(BLOCKS * (CHUNK + 3), np.int32), np.empty(BLOCKS, np.int64)
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

    ``grad_depth`` is None without depth; ``behind`` (3,) in float64 receives the background's gradient unless it is
    None.
    """
    strips = (grad_alpha.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    flat, buf = sums.reshape(-1), np.zeros(7 * LANES, np.float32)
    flat_records = records.reshape(-1)
    work = np.empty(2 * LANES * AT_ONCE, np.float32)
    flat[:] = ZERO
    most = start[0]  # entries of a tile
    for tile in range(start.shape[0] - 1):
        most = max(most, used[tile, BLOCKS] - start[tile])
    stride = most + 3
    lists, counts = np.empty(BLOCKS * stride, np.int32), np.empty(BLOCKS, np.int64)
    for tile in range(start.shape[0] - 1):
        if behind is None and used[tile, BLOCKS] == start[tile]:
            continue
        top, left = row_low + tile // strips * TILE_HEIGHT, tile % strips * TILE_WIDTH
        hand_out(entries, start[tile], used[tile, BLOCKS], lists, stride, counts, records.shape[0] - 1)
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
            first, end = p * stride, p * stride + used[tile, p]
            backward_block(flat_records, lists, first, end, x, y, alpha_max, buf, work, flat, grad_depth)
