"""Compositing of one band's tiles, and its adjoint: the two hot loops.

A tile is 8 x 16 pixels, numbered row by row. The innermost loops run over the pixels of a tile that a kernel may touch,
without branches and within one flat array, so that LLVM turns them into vector instructions. Validity is decided on the
exponent, because the polynomial is invalid outside its range. ``records`` and ``entries`` are those of projection.py
and binning.py.
"""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"
import numba
import numpy as np

from gausim.kernels.jit import HELPER, KERNEL
from gausim.render.cpu.binning import TILE_HEIGHT, TILE_WIDTH
from gausim.render.cpu.projection import S_BLUE, S_GREEN, S_RED, S_X, S_XX, S_XY, S_Y, S_YY, S
from gausim.render.limits import ALPHA_MAX

PIXELS = TILE_WIDTH * TILE_HEIGHT
PAIR = 2 * TILE_WIDTH  # pixels of two rows, the unit of the entries' row ranges
MOST = np.float32(ALPHA_MAX)
T_STOP = np.float32(1e-4)  # a kernel that would leave less transmittance than this ends its pixel (3DGS)
CHECK_EVERY = 8  # kernels between two checks whether a pixel of the tile is still open

# e^u = p(u)^8 with p the minimax polynomial of e^(u) on [-0.7, 0]; relative error 6e-7 after the eighth power.
P0, P1, P2 = np.float32(0.999999921), np.float32(0.999992539), np.float32(0.499882588)
P3, P4, P5 = np.float32(0.165973976), np.float32(0.0397725622), np.float32(0.0058467601)
ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)


@numba.njit(fastmath=True, **HELPER)
def exponential(u):
    """e^(8 u) for u in [-0.7, 0]."""
    p = P0 + u * (P1 + u * (P2 + u * (P3 + u * (P4 + u * P5))))
    p = p * p
    p = p * p
    return p * p


@numba.njit(fastmath=True, **HELPER)
def write_grid(buf, at):
    """Writes x and y of the pixel centres, relative to the tile's corner, to ``buf[at:]`` and ``buf[at + PIXELS:]``."""
    for i in range(PIXELS):
        buf[at + i] = np.float32(i % TILE_WIDTH) + HALF
        buf[at + PIXELS + i] = np.float32(i // TILE_WIDTH) + HALF


@numba.njit(fastmath=True, **HELPER)
def mean_in_tile(records, g, left, top):
    """Mean of a kernel relative to the tile's corner; whole and fractional parts are kept apart, see RECORD."""
    x = (np.float64(records[g, 0]) - left) + np.float64(records[g, 1])
    y = (np.float64(records[g, 2]) - top) + np.float64(records[g, 3])
    return np.float32(x), np.float32(y)


@numba.njit(fastmath=True, **HELPER)
def forward_tile(records, entries, begin, end, left, top, buf):
    """Composites the entries ``begin .. end - 1`` into ``buf`` = [T | R | G | B | last | x | y] (7, PIXELS).

    T turns negative where the pixel is closed; ``last`` is the row of the last kernel that contributed.

    Returns:
        One past the last entry that was read: the tile ends early when all its pixels are closed.
    """
    for i in range(PIXELS):
        buf[i] = ONE
        buf[PIXELS + i] = buf[2 * PIXELS + i] = buf[3 * PIXELS + i] = ZERO
        buf[4 * PIXELS + i] = -ONE
    for e in range(begin, end):
        if (e - begin) % CHECK_EVERY == CHECK_EVERY - 1:
            open_ = -ONE
            for i in range(PIXELS):
                open_ = max(open_, buf[i])
            if open_ <= ZERO:
                return e
        packed = entries[e]
        g = packed >> 8
        row = np.float32(g)
        mx, my = mean_in_tile(records, g, left, top)
        a, b, c, o, cut = records[g, 4], records[g, 5], records[g, 6], records[g, 7], records[g, 11]
        red, green, blue = records[g, 8], records[g, 9], records[g, 10]
        for i in range(((packed >> 4) & 15) * PAIR, (packed & 15) * PAIR + PAIR):
            dx, dy = buf[5 * PIXELS + i] - mx, buf[6 * PIXELS + i] - my
            u = dx * (a * dx + b * dy) + c * dy * dy
            alpha = min(o * exponential(u), MOST) if u >= cut else ZERO
            t = buf[i]
            after = t - t * alpha
            keep = after > T_STOP
            w = alpha * t if keep else ZERO
            buf[PIXELS + i] += w * red
            buf[2 * PIXELS + i] += w * green
            buf[3 * PIXELS + i] += w * blue
            buf[4 * PIXELS + i] = max(buf[4 * PIXELS + i], row if w > ZERO else -ONE)
            buf[i] = after if keep else -abs(t)
    return end


@numba.njit(fastmath=True, **HELPER)
def backward_tile(records, entries, begin, end, left, top, buf, sums):
    """Adds the tile's part to ``sums`` (rows, SUMS); ``buf`` = [T | B | vr | vg | vb | last | x | y] (8, PIXELS).

    Runs back to front: B is the derivative with respect to the transmittance behind the current kernel, by the
    recursion B <- B + alpha (d - B) with d = v . colour of the kernel; T is the transmittance in front of it.
    """
    final = -ONE
    for i in range(PIXELS):
        final = max(final, buf[5 * PIXELS + i])
    for e in range(end - 1, begin - 1, -1):
        packed = entries[e]
        g = packed >> 8
        row = np.float32(g)
        if row > final:
            continue
        mx, my = mean_in_tile(records, g, left, top)
        a, b, c, o, cut = records[g, 4], records[g, 5], records[g, 6], records[g, 7], records[g, 11]
        red, green, blue = records[g, 8], records[g, 9], records[g, 10]
        m0, m1, m2, m11, m12, m22 = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
        s_red, s_green, s_blue = ZERO, ZERO, ZERO
        for i in range(((packed >> 4) & 15) * PAIR, (packed & 15) * PAIR + PAIR):
            dx, dy = buf[6 * PIXELS + i] - mx, buf[7 * PIXELS + i] - my
            u = dx * (a * dx + b * dy) + c * dy * dy
            raw = o * exponential(u)
            alpha = min(raw, MOST) if (u >= cut) & (buf[5 * PIXELS + i] >= row) else ZERO
            t = buf[i] / (ONE - alpha)
            buf[i] = t
            w = alpha * t
            vr, vg, vb = buf[2 * PIXELS + i], buf[3 * PIXELS + i], buf[4 * PIXELS + i]
            gap = vr * red + vg * green + vb * blue - buf[PIXELS + i]
            buf[PIXELS + i] += alpha * gap
            s = w * gap if raw <= MOST else ZERO  # at its ceiling alpha does not depend on the exponent
            sx, sy = s * dx, s * dy
            m0 += s
            m1 += sx
            m2 += sy
            m11 += sx * dx
            m12 += sx * dy
            m22 += sy * dy
            s_red += w * vr
            s_green += w * vg
            s_blue += w * vb
        sums[g, S] += m0
        sums[g, S_X] += m1
        sums[g, S_Y] += m2
        sums[g, S_XX] += m11
        sums[g, S_XY] += m12
        sums[g, S_YY] += m22
        sums[g, S_RED] += s_red
        sums[g, S_GREEN] += s_green
        sums[g, S_BLUE] += s_blue


@numba.njit(fastmath=True, **KERNEL)
def forward_band(records, entries, start, row_low, background, rgb, alpha, final, last, used):
    """Draws one band into ``rgb`` (H, W, 3) and ``alpha`` (H, W).

    ``final`` and ``last`` (tiles, PIXELS) receive the remaining transmittance and the row of the last kernel that
    contributed, ``used`` (tiles,) one past the last entry that was read.
    """
    height, width = alpha.shape
    strips = (width + TILE_WIDTH - 1) // TILE_WIDTH
    buf = np.empty(7 * PIXELS, np.float32)
    write_grid(buf, 5 * PIXELS)
    for tile in range(start.shape[0] - 1):
        top, left = row_low + tile // strips * TILE_HEIGHT, tile % strips * TILE_WIDTH
        used[tile] = forward_tile(records, entries, start[tile], start[tile + 1], left, top, buf)
        for i in range(PIXELS):
            final[tile, i], last[tile, i] = abs(buf[i]), buf[4 * PIXELS + i]
        for y in range(top, min(top + TILE_HEIGHT, height)):
            for x in range(left, min(left + TILE_WIDTH, width)):
                i = (y - top) * TILE_WIDTH + x - left
                t = abs(buf[i])
                for c in range(3):
                    rgb[y, x, c] = buf[(1 + c) * PIXELS + i] + t * background[c]
                alpha[y, x] = ONE - t


@numba.njit(fastmath=True, **HELPER)
def read_tile(grad_rgb, grad_alpha, background, left, top, buf):
    """Fills [B | vr | vg | vb] of ``buf`` with the loss gradients of a tile's pixels, 0 beyond the edge."""
    height, width = grad_alpha.shape
    buf[PIXELS : 5 * PIXELS] = ZERO
    for y in range(top, min(top + TILE_HEIGHT, height)):
        for x in range(left, min(left + TILE_WIDTH, width)):
            i = (y - top) * TILE_WIDTH + x - left
            behind = -grad_alpha[y, x]
            for c in range(3):
                behind += grad_rgb[y, x, c] * background[c]
                buf[(2 + c) * PIXELS + i] = grad_rgb[y, x, c]
            buf[PIXELS + i] = behind


@numba.njit(fastmath=True, **KERNEL)
def backward_band(records, entries, start, row_low, background, grad_rgb, grad_alpha, final, last, used, sums, behind):
    """Adjoint of :func:`forward_band`: writes the band's ``sums`` (rows, SUMS).

    ``behind`` (3,), float64 or None, receives the background's loss gradient.
    """
    strips = (grad_alpha.shape[1] + TILE_WIDTH - 1) // TILE_WIDTH
    buf = np.empty(8 * PIXELS, np.float32)
    write_grid(buf, 6 * PIXELS)
    sums[:] = ZERO
    for tile in range(start.shape[0] - 1):
        if behind is None and used[tile] == start[tile]:
            continue
        top, left = row_low + tile // strips * TILE_HEIGHT, tile % strips * TILE_WIDTH
        read_tile(grad_rgb, grad_alpha, background, left, top, buf)
        for i in range(PIXELS):
            buf[i], buf[5 * PIXELS + i] = final[tile, i], last[tile, i]
        if behind is not None:
            for i in range(PIXELS):
                for c in range(3):
                    behind[c] += final[tile, i] * buf[(2 + c) * PIXELS + i]
        backward_tile(records, entries, start[tile], used[tile], left, top, buf, sums)
