"""Assignment of projected Gaussians to the tiles of one band, in depth order."""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls
import math

import numba
import numpy as np

from gausim.kernels.jit import FINITE_MATH_OFF, HELPER, KERNEL
from gausim.render.cpu.projection import RECORD

# numba compiles constants into its cached code and checks only the file of the function for changes: after changing a
# constant that other files import, delete their cache (__pycache__/*.nb?).
TILE_WIDTH = 8  # [pixels]: half a vector of float32
TILE_HEIGHT = 16  # [pixels]
HALF, ONE, SEVEN, WIDTH, ZERO = np.float32(0.5), np.float32(1), np.float32(7), np.float32(TILE_WIDTH), np.float32(0)


@numba.njit(fastmath=FINITE_MATH_OFF, **HELPER)
def strip_rows(extent, strip, low_row, high_row):
    """First and last pixel row within [low_row, high_row] that an ellipse touches in a column strip.

    Between the pixel centres xa..xb of a strip the ellipse is highest at its apex -(B/A) Y or at the border nearest to
    it, where y = -(B/C) x + sqrt(t/C - det Q / C^2 x^2); likewise its lowest point. The last is before the first where
    the strip is missed.
    """
    reach, slack = extent[2], extent[3] + HALF
    x = np.float32(strip) * WIDTH + HALF - extent[0]
    left, right = min(max(x, -reach), reach), min(max(x + SEVEN, -reach), reach)
    at = min(max(left, extent[5]), right)
    high = math.sqrt(max(extent[6] - extent[7] * at * at, ZERO)) - extent[4] * at
    at = min(max(left, -extent[5]), right)
    low = ZERO - math.sqrt(max(extent[6] - extent[7] * at * at, ZERO)) - extent[4] * at
    # Clamped before the conversion to integers, which overflow for a huge ellipse.
    first = min(max(low + (extent[1] - slack), np.float32(low_row)), np.float32(high_row) + ONE)
    last = max(min(high + (extent[1] + slack - ONE), np.float32(high_row)), np.float32(low_row) - ONE)
    return math.ceil(first), math.floor(last)


@numba.njit(fastmath=FINITE_MATH_OFF, **HELPER)
def collect_band(records, extents, order, spans, row_of, row_low, row_high, strips):
    """Copies the records of the kernels that may touch a band, near to far; ``order`` and ``spans`` by depth_order.

    ``row_of`` (K,) receives the rows of the copied kernels in the band.

    Returns:
        band records (m, RECORD); their kernels (m,); the first and one past the last column strip of each (m, 2); and
        where the list of each strip starts when every kernel is in the lists of all its strips (strips + 1,).
    """
    chosen = np.empty(order.shape[0], np.int32)
    m = 0
    for i in range(order.shape[0]):
        chosen[m] = order[i]
        m += (spans[i, 0] <= row_high) & (spans[i, 1] >= row_low)  # without a branch, which would be unpredictable
    band_records, reach = np.empty((m, RECORD), np.float32), np.empty((m, 2), np.int32)
    begins = np.zeros(strips + 2, np.int64)
    for i in range(m):
        g = chosen[i]
        row_of[g] = i
        for j in range(RECORD):
            band_records[i, j] = records[g, j]
        middle, half = extents[g, 0] - HALF, extents[g, 2] + extents[g, 3]
        first = int(min(max(middle - half, ZERO), strips * WIDTH)) // TILE_WIDTH
        end = int(min(max(middle + half, -WIDTH), strips * WIDTH - HALF) + WIDTH) // TILE_WIDTH
        end = max(first, end)
        reach[i, 0], reach[i, 1] = first, end
        begins[first + 1] += 1
        begins[end + 1] -= 1
    for _ in range(2):  # from changes to lengths, from lengths to positions
        for strip in range(strips):
            begins[strip + 1] += begins[strip]
    return band_records, chosen[:m], reach, begins[: strips + 1]


@numba.njit(fastmath=FINITE_MATH_OFF, **KERNEL)
def bin_band(records, extents, order, spans, row_of, row_low, row_high, strips):
    """Lists for every tile of a band the kernels that touch it, near to far.

    First every column strip lists its kernels with their rows, then each tile selects from its strip's list. The
    selection reads every kernel of the strip without a branch, which is faster while a band is a few tiles high.

    Returns:
        band records (m, RECORD); entries (E,), each ``row << 8 | first pair of pixel rows in the
        tile << 4 | last``; and where each tile's entries start (tiles + 1,). Tiles are numbered row by row.
    """
    band_records, chosen, reach, begins = collect_band(
        records, extents, order, spans, row_of, row_low, row_high, strips
    )  # fmt: skip
    cursor, listed = begins[:-1].copy(), np.empty((begins[-1], 3), np.int32)
    for m in range(chosen.shape[0]):
        for strip in range(reach[m, 0], reach[m, 1]):
            first, last = strip_rows(extents[chosen[m]], strip, row_low, row_high)
            at = cursor[strip]
            cursor[strip] = at + 1
            listed[at, 0], listed[at, 1], listed[at, 2] = m, first - row_low, last - row_low
    tile_rows = (row_high - row_low) // TILE_HEIGHT + 1
    start = np.zeros(strips * tile_rows + 1, np.int64)
    entries = np.empty(begins[-1] * tile_rows + 1, np.int32)
    count = 0
    for tile in range(strips * tile_rows):
        top = tile // strips * TILE_HEIGHT
        for at in range(begins[tile % strips], begins[tile % strips + 1]):
            first, last = max(listed[at, 1] - top, 0), min(listed[at, 2] - top, TILE_HEIGHT - 1)
            entries[count] = (listed[at, 0] << 8) | ((first >> 1) << 4) | (last >> 1)
            count += first <= last
        start[tile + 1] = count
    return band_records, entries[:count].copy(), start
