"""Fast form of :func:`gausim.ops.similarity.image_loss`: one pass over the rows of each image.

An image is a flat run of H W 3 floats. For each row inside the box that is not black, five maps (x, y, x^2, x y, y^2)
are blurred along H, then along W, and give the derivatives of SSIM with respect to the blurred x, x^2 and x y. These
pass through the adjoint of the blur: along W at once, along H when the rows below are computed, too. So only as many
rows as the window is high are kept, and they stay in the first cache. Channels lie interleaved: a step along W is three
floats. Inner loops run over one row without branches, on indices that cannot be negative, so that LLVM turns them into
vector instructions; the tuple of taps has its length in its type, so loops over it unroll.
"""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls
import numba
import numpy as np
import torch
from numba.cpython.unsafe.tuple import tuple_setitem
from torch import Tensor

from gausim.kernels.jit import HELPER, KERNEL
from gausim.kernels.operations import SSIM_C1, SSIM_C2, array
from gausim.kernels.pool import shared_pool

C1, C2 = np.float32(SSIM_C1), np.float32(SSIM_C2)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
# fastmath without the assumption of finite numbers: the loss of a prediction that is not finite must not be finite.
FAST = {"contract", "reassoc", "nsz", "arcp"}


@numba.njit(fastmath=FAST, **HELPER)
def blur_moments(x, y, rows, taps, maps, pad):
    """Blurs x, y, x^2, x y and y^2 along H into the five ``maps`` from column ``pad`` on.

    ``rows`` are the offsets in ``x`` and ``y`` of the rows under the window.
    """
    m0, m1, m2, m3, m4 = maps[0, pad:], maps[1, pad:], maps[2, pad:], maps[3, pad:], maps[4, pad:]
    for i in range(maps.shape[1] - 2 * pad):
        a, b, aa, ab, bb = ZERO, ZERO, ZERO, ZERO, ZERO
        for k in range(len(taps)):
            j = rows[k] + np.uint64(i)
            u, v = x[j], y[j]
            tu, tv = taps[k] * u, taps[k] * v
            a += tu
            b += tv
            aa += tu * u
            ab += tu * v
            bb += tv * v
        m0[i] = a
        m1[i] = b
        m2[i] = aa
        m3[i] = ab
        m4[i] = bb


@numba.njit(fastmath=FAST, **HELPER)
def ssim_slopes(maps, taps, slopes, pad):
    """Blurs the ``maps`` along W; returns the row's sum of 1 - SSIM and writes the ``slopes`` from column ``pad`` on.

    The slopes are the derivatives of SSIM with respect to the blurred x, x^2 and x y.
    """
    s0, s1, s2 = slopes[0, pad:], slopes[1, pad:], slopes[2, pad:]
    m0, m1, m2, m3, m4 = maps[0], maps[1], maps[2], maps[3], maps[4]
    total = ZERO
    for i in range(slopes.shape[1] - 2 * pad):
        a, b, aa, ab, bb = ZERO, ZERO, ZERO, ZERO, ZERO
        for k in range(len(taps)):
            j = i + 3 * k
            a += taps[k] * m0[j]
            b += taps[k] * m1[j]
            aa += taps[k] * m2[j]
            ab += taps[k] * m3[j]
            bb += taps[k] * m4[j]
        product, square_a, square_b = a * b, a * a, b * b
        above_means, above = TWO * product + C1, TWO * (ab - product) + C2
        below_means, below = square_a + square_b + C1, (aa - square_a) + (bb - square_b) + C2
        inverse = ONE / (below_means * below)
        value = above_means * above * inverse
        by_square, by_product = -value * below_means * inverse, TWO * above_means * inverse
        total += ONE - value
        s0[i] = TWO * b * above * inverse - TWO * a * (value * below * inverse + by_square) - b * by_product
        s1[i] = by_square
        s2[i] = by_product
    return total


@numba.njit(fastmath=FAST, **HELPER)
def spread_along_width(slopes, taps, spread):
    """The adjoint of the blur along W with borders; ``slopes`` has margins of zeros, ``spread`` includes its margin."""
    half = 3 * (len(taps) // 2)
    for m in range(3):
        source, target = slopes[m], spread[m]
        count = target.shape[0]
        for i in range(count):
            total = ZERO
            for k in range(len(taps)):
                total += taps[k] * source[i + 3 * k]
            target[i] = total
        for j in range(1, len(taps) // 2 + 1):  # values beyond the border belong to the reflected pixel
            for c in range(3):
                target[half + 3 * j + c] += target[half - 3 * j + c]
                target[count - half - 3 - 3 * j + c] += target[count - half - 3 + 3 * j + c]


@numba.njit(fastmath=FAST, **HELPER)
def gather_row(spread, offsets, weights, x, y, by_error, by_ssim, gradient):
    """Loss gradient and sum of squared errors of one row; ``offsets`` and ``weights`` are of the rows around it."""
    first = spread.reshape(-1)
    second, third = first[spread.shape[2] :], first[2 * spread.shape[2] :]
    total = ZERO
    for i in range(gradient.shape[0]):
        p, q, r = ZERO, ZERO, ZERO
        for k in range(len(weights)):
            j = offsets[k] + np.uint64(i)
            p += weights[k] * first[j]
            q += weights[k] * second[j]
            r += weights[k] * third[j]
        u, v = x[i], y[i]
        error = u - v
        total += error * error
        gradient[i] = by_error * error + by_ssim * (p + TWO * u * q + v * r)
    return total


@numba.njit(fastmath=FAST, **HELPER)
def mark_colour(x, y, columns):
    """Marks the columns of one row where an image is not zero; returns true if there is one."""
    found = np.int32(0)
    for i in range(columns.shape[0]):
        here = np.int32((x[i] != ZERO) | (y[i] != ZERO))
        columns[i] |= here
        found |= here
    return found != 0


@numba.njit(**HELPER)
def widened(low, high, length, margin, least):
    """The range low..high with a margin, at least ``least`` long, within 0..length."""
    low, high = max(0, low - margin), min(length, high + margin)
    if high - low < least:
        low = max(0, min(low, length - least))
        high = min(length, low + least)
    return low, high


@numba.njit(**HELPER)
def coloured_box(x, y, height, width, window):
    """Rows and columns (top, bottom, left, right) outside which the loss and its gradient are exactly zero."""
    columns = np.zeros(3 * width, np.int32)
    top, bottom, left, right = height, 0, width, 0
    for row in range(height):
        at = row * 3 * width
        if mark_colour(x[at : at + 3 * width], y[at : at + 3 * width], columns):
            top, bottom = min(top, row), row + 1
    for column in range(width):
        if columns[3 * column] | columns[3 * column + 1] | columns[3 * column + 2]:
            left, right = min(left, column), column + 1
    if bottom == 0:
        return 0, 0, 0, 0
    # A coloured pixel touches windows within half of one, and through them pixels within a whole one.
    top, bottom = widened(top, bottom, height, window - 1, window)
    left, right = widened(left, right, width, window - 1, window)
    return top, bottom, left, right


@numba.njit(**HELPER)
def reflected(row, top, bottom):
    """The row that replaces one beyond the border, by reflection without repeating the border row."""
    if row < top:
        row = 2 * top - row
    return 2 * (bottom - 1) - row if row >= bottom else row


@numba.njit(**HELPER)
def adjoint_weights(row, top, bottom, taps, slots, size, inset):
    """Offsets and weights of the spread rows around ``row``, such that gathering them is the adjoint of the blur."""
    window, half = len(taps), len(taps) // 2
    offsets, weights = slots, taps
    for k in range(window):
        source = row + k - half
        weight = np.float32(0)
        if top <= source < bottom:
            for tap in range(window):  # the row itself, and the rows beyond a border that it replaces
                if reflected(source + tap - half, top, bottom) == row:
                    weight += taps[tap]
        offsets = tuple_setitem(offsets, k, np.uint64((source % window) * size + inset))
        weights = tuple_setitem(weights, k, weight)
    return offsets, weights


@numba.njit(**KERNEL)
def compare(x, y, shape, taps, slots, by_error, by_ssim, gradient):
    """Sums of squared errors and of 1 - SSIM over pixels and channels of one image; writes the loss gradient.

    Args:
        x: the prediction, H W 3 floats in a row.
        y: the truth, likewise.
        shape: (H, W), each at least the window.
        taps: weights of the window along one axis, a tuple of float32 of odd length.
        slots: a tuple of as many uint64 (numba compiles for the length in its type).
        by_error: twice the factor of the squared errors in the loss.
        by_ssim: factor of SSIM in the loss.
        gradient: output, as long as ``x``.
    """
    height, width = shape
    window, half = len(taps), len(taps) // 2
    top, bottom, left, right = coloured_box(x, y, height, width, window)
    gradient[: (top * width + left) * 3] = ZERO
    count, inset = 3 * (right - left), 3 * half
    maps = np.empty((5, count + 2 * inset), np.float32)
    slopes = np.zeros((3, count + 4 * inset), np.float32)
    spread = np.zeros((window, 3, count + 2 * inset), np.float32)
    squared, dissimilar, done = 0.0, 0.0, (top * width + left) * 3
    for row in range(top, bottom + half if bottom > top else top):
        if row < bottom:
            rows = slots
            for k in range(window):
                rows = tuple_setitem(rows, k, np.uint64((reflected(row + k - half, top, bottom) * width + left) * 3))
            blur_moments(x, y, rows, taps, maps, inset)
            for j in range(1, half + 1):
                for m in range(5):
                    for c in range(3):
                        maps[m, inset - 3 * j + c] = maps[m, inset + 3 * j + c]
                        maps[m, inset + count - 3 + 3 * j + c] = maps[m, inset + count - 3 - 3 * j + c]
            dissimilar += ssim_slopes(maps, taps, slopes, 2 * inset)
            spread_along_width(slopes, taps, spread[row % window])
        ready = row - half
        if ready >= top:
            at = (ready * width + left) * 3
            offsets, weights = adjoint_weights(ready, top, bottom, taps, slots, spread[0].size, inset)
            gradient[done:at] = ZERO
            done = at + count
            squared += gather_row(
                spread, offsets, weights, x[at:done], y[at:done], by_error, by_ssim, gradient[at:done]
            )
    gradient[done:] = ZERO
    return squared, dissimilar


def image_loss(
    prediction: Tensor, target: Tensor, taps: tuple[float, ...], *, balance: float, scale: float
) -> tuple[Tensor, Tensor]:
    """:func:`gausim.ops.similarity.image_loss`, on torch's number of threads."""
    states, views, height, width, _ = prediction.shape
    x, y = (array(v).reshape(states * views, -1) for v in (prediction, target))
    gradient, sums = np.empty_like(x), np.empty((states * views, 2))
    # The length of the window is part of the type of these tuples.
    window, slots = tuple(np.float32(tap) for tap in taps), (np.uint64(0),) * len(taps)
    by_error, by_ssim = np.float32(2 * scale * balance), np.float32(-0.5 * scale * (1 - balance))

    def one(i: int) -> None:
        sums[i] = compare(x[i], y[i], (height, width), window, slots, by_error, by_ssim, gradient[i])

    shared_pool(torch.get_num_threads()).run(one, range(states * views))
    values = scale * (sums @ np.array([balance, 0.5 * (1 - balance)])).reshape(states, views).sum(1)
    return torch.from_numpy(values.astype(np.float32)), torch.from_numpy(gradient.reshape(prediction.shape))
