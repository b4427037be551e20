"""Assignment of projected Gaussians to the tiles of one band, in depth order."""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import math

import numba
import numpy as np

from gausim.render.cpu.projection import EXTENT, FINITE_MATH_OFF, RECORD

# numba freezes constants into its cached code and looks only at the file that holds the function: after changing a
# constant that other files import, delete their cache (__pycache__/*.nb?).
TILE_WIDTH = 8  # [pixels]: one vector of float32
TILE_HEIGHT = 16  # [pixels]
SLACK = 0.002  # [pixels] added to every extent, far above its rounding error


@numba.njit(nogil=True, fastmath=FINITE_MATH_OFF, error_model="numpy", cache=True, inline="always")
def strip_range(extent, strips):
    """First and one past the last 8-pixel column strip that holds a pixel centre within the ellipse's width."""
    reach = extent[2] + SLACK
    low = min(max(math.ceil(extent[0] - reach - 0.5), 0.0), strips * 8.0)
    high = min(max(math.floor(extent[0] + reach - 0.5), -1.0), strips * 8.0 - 1.0)
    return int(low) // TILE_WIDTH, int(high + 8.0) // TILE_WIDTH


@numba.njit(nogil=True, fastmath=FINITE_MATH_OFF, error_model="numpy", cache=True, inline="always")
def strip_rows(extent, strip, row_low, row_high):
    """First and last pixel row within [row_low, row_high] that the ellipse touches inside a column strip."""
    reach = extent[2]
    left = min(max(strip * 8.0 + 0.5 - extent[0], -reach), reach)
    right = min(max(strip * 8.0 + 7.5 - extent[0], -reach), reach)
    apex = extent[5]
    at = min(max(apex, left), right)
    high = -extent[4] * at + math.sqrt(max(0.0, extent[6] - extent[7] * at * at))
    at = min(max(-apex, left), right)
    low = -extent[4] * at - math.sqrt(max(0.0, extent[6] - extent[7] * at * at))
    first = max(math.ceil(extent[1] + low - 0.5 - SLACK), float(row_low))
    last = min(math.floor(extent[1] + high - 0.5 + SLACK), float(row_high))
    if first > last:
        return 0, -1
    return int(first), int(last)


@numba.njit(nogil=True, fastmath=FINITE_MATH_OFF, error_model="numpy", cache=True)
def collect_band(records, extents, order, row_of, row_low, row_high, strips):
    """Copies the records of the kernels that may touch a band, near to far.

    ``row_of`` (n,) receives the band-local row of every projected kernel, or -1.

    Returns:
        band records (m, RECORD), band extents (m, EXTENT) and an upper bound on the number of tile entries.
    """
    n = order.shape[0]
    chosen = np.empty(n, np.int32)
    m, bound = 0, 0
    for i in range(n):
        g = order[i]
        reach = extents[g, 3] + SLACK + 0.5
        low, high = extents[g, 1] - reach, extents[g, 1] + reach
        row_of[g] = -1
        if high < row_low or low > row_high + 1:
            continue
        first, last = strip_range(extents[g], strips)
        if first >= last:
            continue
        tiles_high = int(min(high, row_high)) // TILE_HEIGHT - int(max(low, row_low)) // TILE_HEIGHT + 1
        bound += (last - first) * tiles_high
        row_of[g] = m
        chosen[m] = g
        m += 1
    band_records = np.empty((m, RECORD), np.float32)
    band_extents = np.empty((m, EXTENT), np.float64)
    for i in range(m):
        for j in range(RECORD):
            band_records[i, j] = records[chosen[i], j]
        for j in range(EXTENT):
            band_extents[i, j] = extents[chosen[i], j]
    return band_records, band_extents, bound


@numba.njit(nogil=True, fastmath=FINITE_MATH_OFF, error_model="numpy", cache=True)
def fill_tiles(extents, bound, row_low, row_high, strips):
    """Lists for every tile of a band the kernels that touch it, near to far.

    Returns:
        entries (E,), each ``row << 8 | first pixel row in the tile << 4 | last``, and where each tile's entries start
        (tiles + 1,); tiles are numbered row by row.
    """
    top = row_low // TILE_HEIGHT
    tiles = strips * ((row_high - row_low) // TILE_HEIGHT + 1)
    start = np.zeros(tiles + 1, np.int64)
    tile_of, packed = np.empty(bound, np.int32), np.empty(bound, np.int32)
    count = 0
    for g in range(extents.shape[0]):
        extent = extents[g]
        first_strip, end_strip = strip_range(extent, strips)
        for strip in range(first_strip, end_strip):
            first, last = strip_rows(extent, strip, row_low, row_high)
            if first > last:
                continue
            for tile_row in range(first // TILE_HEIGHT, last // TILE_HEIGHT + 1):
                base = tile_row * TILE_HEIGHT
                low, high = max(first - base, 0), min(last - base, TILE_HEIGHT - 1)
                tile = (tile_row - top) * strips + strip
                tile_of[count], packed[count] = tile, (g << 8) | (low << 4) | high
                start[tile + 1] += 1
                count += 1
    for tile in range(tiles):
        start[tile + 1] += start[tile]
    entries, cursor = np.empty(count, np.int32), start[:-1].copy()
    for e in range(count):
        at = cursor[tile_of[e]]
        cursor[tile_of[e]] = at + 1
        entries[at] = packed[e]
    return entries, start
