"""Compositing of one band's tiles, and its adjoint: the two hot loops.

A tile is 8 x 16 pixels, eight vectors of two rows each. Validity is decided on the exponent: the polynomial is
meaningless outside its range. ``depth`` is an image or None; numba compiles the two cases apart, so that images without
depth do not pay for it.
"""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"
from __future__ import annotations

import numba
import numpy as np

from gausim.ops.jit import HELPER, KERNEL
from gausim.render.cpu.binning import TILE_HEIGHT, TILE_WIDTH
from gausim.render.cpu.simd import (
    LANES,
    column_centres,
    lane_sums,
    largest,
    load,
    magnitude,
    maximum,
    minimum,
    row_centres,
    select,
    splat,
    store,
)

PIXELS = TILE_WIDTH * TILE_HEIGHT
SUMS = LANES  # per kernel: s, s dx, s dx^2, s dy, s dx dy, s dy^2, w v (3), w v_depth; the rest is zero
T_STOP = np.float32(1e-4)  # a kernel that would leave less transmittance than this ends its pixel (3DGS)
CHECK_EVERY = 8  # entries between two looks at whether any pixel of the tile is still open

# e^u = p(u)^8 with p the minimax polynomial of e^(u) on [-0.7, 0]; relative error 6e-7 after the eighth power.
P0, P1, P2 = np.float32(0.999999921), np.float32(0.999992539), np.float32(0.499882588)
P3, P4, P5 = np.float32(0.165973976), np.float32(0.0397725622), np.float32(0.0058467601)
ZERO, ONE = np.float32(0), np.float32(1)

# Arithmetic per pixel and entry in the loops over pairs of rows, a fused multiply-add counted as two; comparisons,
# selections, loads and stores not at all. For the share of the machine's peak in ``gausim benchmark render``.
FORWARD_FLOPS = 1 + 4 + 10 + 3 + 1 + 2 + 6  # dy, u, p, p^8, o p, t alpha and t - that, three colours
# dy, u, p, p^8, o p, t / (1 - alpha), w, gap, behind, s, s dy, sums of s, s dy and s dy dy, sums of w v
BACKWARD_FLOPS = 1 + 4 + 10 + 3 + 1 + 2 + 1 + 6 + 2 + 1 + 1 + 4 + 6


@numba.njit(fastmath=True, **HELPER)
def forward_tile(records, entries, begin, end, left, top, alpha_max, buf, depth):
    """Composites entries ``begin..end`` into ``buf`` = [T | last | R | G | B | D], one value per pixel each.

    T turns negative where the pixel is closed; ``last`` is the row of the last kernel that was seen before that.

    Returns:
        One past the last entry that was looked at: the tile ends early when all its pixels are closed.
    """
    for i in range(0, PIXELS, LANES):
        store(buf, i, splat(ONE))
        store(buf, PIXELS + i, splat(-ONE))
        for j in range(2 * PIXELS + i, 6 * PIXELS, PIXELS):
            store(buf, j, splat(ZERO))
    for e in range(begin, end):
        if (e - begin) % CHECK_EVERY == CHECK_EVERY - 1:
            open_ = load(buf, 0)
            for i in range(LANES, PIXELS, LANES):
                open_ = maximum(open_, load(buf, i))
            if largest(open_) <= ZERO:
                return e
        packed = entries[e]
        g = packed >> 8
        r = records[g]
        row = splat(np.float32(g))
        dx = column_centres() - ((r[0] - left) + r[1])
        offset = row_centres() - ((r[2] - top) + r[3])
        cross, square = r[5] * dx, r[4] * dx * dx
        c, o, cut = splat(r[6]), splat(r[7]), splat(r[11])
        for pair in range((packed >> 4) & 15, (packed & 15) + 1):
            i = pair * LANES
            dy = offset + np.float32(2 * pair)
            u = dy * (c * dy + cross) + square
            p = P0 + u * (P1 + u * (P2 + u * (P3 + u * (P4 + u * P5))))
            p = p * p
            p = p * p
            p = p * p
            alpha = select(u >= cut, minimum(o * p, alpha_max), ZERO)
            t = load(buf, i)
            w = t * alpha
            after = t - w
            keep = after > T_STOP
            w = select(keep, w, ZERO)
            store(buf, i, select(keep, after, ZERO - magnitude(t)))
            store(buf, PIXELS + i, select(keep, row, load(buf, PIXELS + i)))
            store(buf, 2 * PIXELS + i, load(buf, 2 * PIXELS + i) + w * r[8])
            store(buf, 3 * PIXELS + i, load(buf, 3 * PIXELS + i) + w * r[9])
            store(buf, 4 * PIXELS + i, load(buf, 4 * PIXELS + i) + w * r[10])
            if depth is not None:
                store(buf, 5 * PIXELS + i, load(buf, 5 * PIXELS + i) + w * r[12])
    return end


@numba.njit(fastmath=True, **HELPER)
def backward_tile(records, entries, begin, end, left, top, alpha_max, buf, sums, depth):
    """Adds the tile's contribution to ``sums`` (rows * SUMS); ``buf`` = [T | last | vr | vg | vb | vd | behind].

    Runs back to front: ``behind`` is the derivative with respect to what lies behind the current kernel, by the
    recursion B <- B + alpha (d - B) with d = v . colour of the kernel; T is the transmittance in front of it. Within an
    entry dx is the same in all vectors, so sums with dx follow from those over the rows.
    """
    for e in range(end - 1, begin - 1, -1):
        packed = entries[e]
        g = packed >> 8
        r = records[g]
        row = splat(np.float32(g))
        dx = column_centres() - ((r[0] - left) + r[1])
        offset = row_centres() - ((r[2] - top) + r[3])
        cross, square = r[5] * dx, r[4] * dx * dx
        c, o, cut = splat(r[6]), splat(r[7]), splat(r[11])
        s0, s1, s2 = splat(ZERO), splat(ZERO), splat(ZERO)
        red, green, blue, far = splat(ZERO), splat(ZERO), splat(ZERO), splat(ZERO)
        for pair in range((packed >> 4) & 15, (packed & 15) + 1):
            i = pair * LANES
            dy = offset + np.float32(2 * pair)
            u = dy * (c * dy + cross) + square
            p = P0 + u * (P1 + u * (P2 + u * (P3 + u * (P4 + u * P5))))
            p = p * p
            p = p * p
            p = p * p
            raw = o * p
            seen = (u >= cut) & (load(buf, PIXELS + i) >= row)
            alpha = select(seen, minimum(raw, alpha_max), ZERO)
            t = load(buf, i) / (ONE - alpha)
            store(buf, i, t)
            w = alpha * t
            vr, vg, vb = load(buf, 2 * PIXELS + i), load(buf, 3 * PIXELS + i), load(buf, 4 * PIXELS + i)
            behind = load(buf, 6 * PIXELS + i)
            gap = vr * r[8] + vg * r[9] + vb * r[10] - behind
            if depth is not None:
                gap += load(buf, 5 * PIXELS + i) * r[12]
                far += w * load(buf, 5 * PIXELS + i)
            store(buf, 6 * PIXELS + i, behind + alpha * gap)
            s = select(raw <= alpha_max, w * gap, ZERO)
            sy = s * dy
            s0 += s
            s1 += sy
            s2 += sy * dy
            red += w * vr
            green += w * vg
            blue += w * vb
        sx = s0 * dx
        parts = (s0, sx, sx * dx, s1, s1 * dx, s2, red, green, blue, far)
        store(sums, g * SUMS, load(sums, g * SUMS) + lane_sums(parts))


@numba.njit(fastmath=True, **KERNEL)
def forward_band(records, entries, start, row_low, background, alpha_max, rgb, alpha, depth, final, last, used):
    """Draws one band into ``rgb`` (H, W, 3), ``alpha`` (H, W) and, unless it is None, ``depth`` (H, W).

    ``final`` and ``last`` (tiles, PIXELS) keep the remaining transmittance and the last contributing row; ``used``
    (tiles,) where the entries end that were looked at.
    """
    height, width = alpha.shape
    strips = (width + TILE_WIDTH - 1) // TILE_WIDTH
    buf = np.empty(6 * PIXELS, np.float32)
    for tile in range(start.shape[0] - 1):
        top, left = row_low + tile // strips * TILE_HEIGHT, tile % strips * TILE_WIDTH
        used[tile] = forward_tile(
            records, entries, start[tile], start[tile + 1], np.float32(left), np.float32(top), alpha_max, buf, depth
        )
        for i in range(PIXELS):
            final[tile, i] = abs(buf[i])
            last[tile, i] = buf[PIXELS + i]
        for y in range(top, min(top + TILE_HEIGHT, height)):
            for x in range(left, min(left + TILE_WIDTH, width)):
                i = (y - top) * TILE_WIDTH + x - left
                t = abs(buf[i])
                rgb[y, x, 0] = buf[2 * PIXELS + i] + t * background[0]
                rgb[y, x, 1] = buf[3 * PIXELS + i] + t * background[1]
                rgb[y, x, 2] = buf[4 * PIXELS + i] + t * background[2]
                alpha[y, x] = ONE - t
                if depth is not None:
                    depth[y, x] = buf[5 * PIXELS + i]


@numba.njit(fastmath=True, **KERNEL)
def backward_band(
    records, entries, start, row_low, background, alpha_max, grad_rgb, grad_alpha, grad_depth, final, last, used, sums,
    behind,
):  # fmt: skip
    """Adjoint of :func:`forward_band`: writes the band's ``sums`` (rows, SUMS).

    ``grad_depth`` is None without depth; ``behind`` (3,) in float64 receives the background's gradient unless it is
    None.
    """
    height, width = grad_alpha.shape
    strips = (width + TILE_WIDTH - 1) // TILE_WIDTH
    flat = sums.reshape(-1)
    flat[:] = ZERO
    buf = np.empty(7 * PIXELS, np.float32)
    for tile in range(start.shape[0] - 1):
        if behind is None and used[tile] == start[tile]:
            continue
        top, left = row_low + tile // strips * TILE_HEIGHT, tile % strips * TILE_WIDTH
        for i in range(PIXELS):
            buf[i] = final[tile, i]
            buf[PIXELS + i] = last[tile, i]
        buf[2 * PIXELS :] = ZERO
        for y in range(top, min(top + TILE_HEIGHT, height)):
            for x in range(left, min(left + TILE_WIDTH, width)):
                i = (y - top) * TILE_WIDTH + x - left
                red, green, blue = grad_rgb[y, x, 0], grad_rgb[y, x, 1], grad_rgb[y, x, 2]
                buf[2 * PIXELS + i] = red
                buf[3 * PIXELS + i] = green
                buf[4 * PIXELS + i] = blue
                buf[6 * PIXELS + i] = (
                    red * background[0] + green * background[1] + blue * background[2] - grad_alpha[y, x]
                )
                if grad_depth is not None:
                    buf[5 * PIXELS + i] = grad_depth[y, x]
                if behind is not None:
                    behind[0] += buf[i] * red
                    behind[1] += buf[i] * green
                    behind[2] += buf[i] * blue
        backward_tile(
            records,
            entries,
            start[tile],
            used[tile],
            np.float32(left),
            np.float32(top),
            alpha_max,
            buf,
            flat,
            grad_depth,
        )
