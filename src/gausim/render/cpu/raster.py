"""Compositing of one band's tiles, and its adjoint: the two hot loops.

Every inner loop runs over the pixels of one tile in a single flat buffer, without branches, so that LLVM turns it into
vector instructions (a test looks for them). Validity is decided on the exponent: the polynomial is meaningless
outside its range.
"""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numba
import numpy as np

from gausim.render.cpu.binning import TILE_HEIGHT, TILE_WIDTH

PIXELS = TILE_WIDTH * TILE_HEIGHT
SUMS = 9  # per kernel: s, s dx, s dx^2, s dy, s dx dy, s dy^2 and the three of w v
T_STOP = 1e-4  # a kernel that would leave less transmittance than this ends its pixel (3DGS)
CHECK_EVERY = 8  # entries between two looks at whether any pixel of the tile is still open

# e^u = p(u)^8 with p the minimax polynomial of e^(u) on [-0.7, 0]; relative error 6e-7 after the eighth power.
P0, P1, P2 = np.float32(0.999999921), np.float32(0.999992539), np.float32(0.499882588)
P3, P4, P5 = np.float32(0.165973976), np.float32(0.0397725622), np.float32(0.0058467601)


@numba.njit(nogil=True, fastmath=True, error_model="numpy", cache=True)
def forward_tile(records, entries, begin, end, left, top, alpha_max, buf):
    """Composites entries ``begin..end`` into ``buf`` = [T | R | G | B | last | x | y], one value per pixel each.

    T turns negative where the pixel is closed; ``last`` is the row of the last kernel that contributed.
    """
    one, zero, stop = np.float32(1), np.float32(0), np.float32(T_STOP)
    for i in range(PIXELS):
        buf[i] = one
        buf[PIXELS + i] = zero
        buf[2 * PIXELS + i] = zero
        buf[3 * PIXELS + i] = zero
        buf[4 * PIXELS + i] = -one
    for e in range(begin, end):
        if (e - begin) % CHECK_EVERY == CHECK_EVERY - 1:
            open_ = np.float32(-1)
            for i in range(PIXELS):
                open_ = max(open_, buf[i])
            if open_ <= zero:
                break
        packed = entries[e]
        g = packed >> 8
        row = np.float32(g)
        r = records[g]
        mx, my = (r[0] - left) + r[1], (r[2] - top) + r[3]
        a, b, c, o, cut = r[4], r[5], r[6], r[7], r[11]
        red, green, blue = r[8], r[9], r[10]
        for i in range(((packed >> 4) & 15) * TILE_WIDTH, (packed & 15) * TILE_WIDTH + TILE_WIDTH):
            dx, dy = buf[5 * PIXELS + i] - mx, buf[6 * PIXELS + i] - my
            u = dx * (a * dx + b * dy) + c * dy * dy
            p = P0 + u * (P1 + u * (P2 + u * (P3 + u * (P4 + u * P5))))
            p = p * p
            p = p * p
            p = p * p
            alpha = min(o * p, alpha_max) if u >= cut else zero
            t = buf[i]
            after = t - t * alpha
            keep = after > stop
            w = alpha * t if keep else zero
            buf[PIXELS + i] += w * red
            buf[2 * PIXELS + i] += w * green
            buf[3 * PIXELS + i] += w * blue
            buf[4 * PIXELS + i] = max(buf[4 * PIXELS + i], row if w > zero else -one)
            buf[i] = after if keep else -abs(t)


@numba.njit(nogil=True, fastmath=True, error_model="numpy", cache=True)
def backward_tile(records, entries, begin, end, left, top, alpha_max, buf, sums):
    """Adds the tile's contribution to ``sums`` (rows, SUMS); ``buf`` = [T | B | vr | vg | vb | last | x | y].

    Runs back to front: B is the derivative with respect to what lies behind the current kernel, by the recursion
    B <- B + alpha (d - B) with d = v . colour of the kernel; T is the transmittance in front of it.
    """
    one, zero = np.float32(1), np.float32(0)
    final = np.float32(-1)
    for i in range(PIXELS):
        final = max(final, buf[5 * PIXELS + i])
    for e in range(end - 1, begin - 1, -1):
        packed = entries[e]
        g = packed >> 8
        row = np.float32(g)
        if row > final:
            continue
        r = records[g]
        mx, my = (r[0] - left) + r[1], (r[2] - top) + r[3]
        a, b, c, o, cut = r[4], r[5], r[6], r[7], r[11]
        red, green, blue = r[8], r[9], r[10]
        m0, m1, m2, m11, m12, m22, s_red, s_green, s_blue = zero, zero, zero, zero, zero, zero, zero, zero, zero
        for i in range(((packed >> 4) & 15) * TILE_WIDTH, (packed & 15) * TILE_WIDTH + TILE_WIDTH):
            dx, dy = buf[6 * PIXELS + i] - mx, buf[7 * PIXELS + i] - my
            u = dx * (a * dx + b * dy) + c * dy * dy
            p = P0 + u * (P1 + u * (P2 + u * (P3 + u * (P4 + u * P5))))
            p = p * p
            p = p * p
            p = p * p
            raw = o * p
            seen = (u >= cut) & (buf[5 * PIXELS + i] >= row)
            alpha = min(raw, alpha_max) if seen else zero
            t = buf[i] / (one - alpha)
            buf[i] = t
            w = alpha * t
            vr, vg, vb = buf[2 * PIXELS + i], buf[3 * PIXELS + i], buf[4 * PIXELS + i]
            behind = buf[PIXELS + i]
            gap = vr * red + vg * green + vb * blue - behind
            buf[PIXELS + i] = behind + alpha * gap
            s = w * gap if raw <= alpha_max else zero
            sx, sy = s * dx, s * dy
            m0 += s
            m1 += sx
            m11 += sx * dx
            m2 += sy
            m12 += sx * dy
            m22 += sy * dy
            s_red += w * vr
            s_green += w * vg
            s_blue += w * vb
        q = sums[g]
        q[0] += m0
        q[1] += m1
        q[2] += m11
        q[3] += m2
        q[4] += m12
        q[5] += m22
        q[6] += s_red
        q[7] += s_green
        q[8] += s_blue


@numba.njit(nogil=True, fastmath=True, error_model="numpy", cache=True, inline="always")
def write_grid(buf, at):
    """Fills two blocks of ``buf`` from ``at`` with the pixel centres relative to the tile's corner."""
    for i in range(PIXELS):
        buf[at + i] = np.float32(i % TILE_WIDTH) + np.float32(0.5)
        buf[at + PIXELS + i] = np.float32(i // TILE_WIDTH) + np.float32(0.5)


@numba.njit(nogil=True, fastmath=True, error_model="numpy", cache=True)
def forward_band(records, entries, start, row_low, background, alpha_max, rgb, alpha, final, last):
    """Draws one band into ``rgb`` (H, W, 3) and ``alpha`` (H, W).

    ``final`` and ``last`` (tiles, PIXELS) keep the remaining transmittance and the last contributing row.
    """
    height, width = alpha.shape
    strips = (width + TILE_WIDTH - 1) // TILE_WIDTH
    buf = np.empty(7 * PIXELS, np.float32)
    write_grid(buf, 5 * PIXELS)
    for tile in range(start.shape[0] - 1):
        top, left = row_low + tile // strips * TILE_HEIGHT, tile % strips * TILE_WIDTH
        forward_tile(records, entries, start[tile], start[tile + 1], np.float32(left), np.float32(top), alpha_max, buf)
        for i in range(PIXELS):
            final[tile, i] = abs(buf[i])
            last[tile, i] = buf[4 * PIXELS + i]
        for y in range(top, min(top + TILE_HEIGHT, height)):
            for x in range(left, min(left + TILE_WIDTH, width)):
                i = (y - top) * TILE_WIDTH + x - left
                t = abs(buf[i])
                rgb[y, x, 0] = buf[PIXELS + i] + t * background[0]
                rgb[y, x, 1] = buf[2 * PIXELS + i] + t * background[1]
                rgb[y, x, 2] = buf[3 * PIXELS + i] + t * background[2]
                alpha[y, x] = np.float32(1) - t


@numba.njit(nogil=True, fastmath=True, error_model="numpy", cache=True)
def backward_band(records, entries, start, row_low, background, alpha_max, grad_rgb, grad_alpha, final, last):
    """Adjoint of :func:`forward_band`: the band's sums (rows, SUMS)."""
    height, width = grad_alpha.shape
    strips = (width + TILE_WIDTH - 1) // TILE_WIDTH
    sums = np.zeros((records.shape[0], SUMS), np.float32)
    buf = np.empty(8 * PIXELS, np.float32)
    write_grid(buf, 6 * PIXELS)
    for tile in range(start.shape[0] - 1):
        if start[tile] == start[tile + 1]:
            continue
        top, left = row_low + tile // strips * TILE_HEIGHT, tile % strips * TILE_WIDTH
        for i in range(PIXELS):
            buf[i] = final[tile, i]
            buf[5 * PIXELS + i] = last[tile, i]
        buf[PIXELS : 5 * PIXELS] = np.float32(0)
        for y in range(top, min(top + TILE_HEIGHT, height)):
            for x in range(left, min(left + TILE_WIDTH, width)):
                i = (y - top) * TILE_WIDTH + x - left
                red, green, blue = grad_rgb[y, x, 0], grad_rgb[y, x, 1], grad_rgb[y, x, 2]
                buf[PIXELS + i] = red * background[0] + green * background[1] + blue * background[2] - grad_alpha[y, x]
                buf[2 * PIXELS + i] = red
                buf[3 * PIXELS + i] = green
                buf[4 * PIXELS + i] = blue
        backward_tile(
            records, entries, start[tile], start[tile + 1], np.float32(left), np.float32(top), alpha_max, buf, sums
        )
    return sums
