"""Projection of Gaussians into one view, and their order by depth."""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls
import math

import numba
import numpy as np

from gausim.kernels.jit import FINITE_MATH_OFF, HELPER, KERNEL
from gausim.render.limits import ALPHA_MIN, CLAMP_MARGIN, DILATION

# Raster record, float32: integer and fractional part of the mean, x then y (so that offsets inside a tile stay exact
# far from the image's origin), -A/16, -B/8, -C/16 of the inverse covariance, opacity, colour, the exponent below which
# alpha < 1/255, over 8; padded to a cache line.
RECORD = 16
# Extent, float32: mean x y, half width X, slack, B/C, -(B/A) Y, t/C, det Q / C^2.
EXTENT = 8
SLACK = 0.002  # [pixels] added to every extent, far above the rounding error of extents up to some thousand pixels,
RELATIVE_SLACK = 2e-6  # and in proportion to the extent above that

# Positions in a row of sums over pixels: of s, s dx, s dx^2, s dy, s dx dy, s dy^2, w v (3).
S, S_X, S_XX, S_Y, S_XY, S_YY, S_RED, S_GREEN, S_BLUE = range(9)
SUMS = 9
ZERO = np.float32(0)
AT_ONCE = 64  # kernels whose sums are gathered before they are used


@numba.njit(**KERNEL)
def count_unusable(means, covars, colors, opacities, low, high):
    """Number of kernels that are not finite or whose opacity lies outside 0..1 (no fastmath, which ignores NaN)."""
    unusable = 0
    for k in range(low, high):
        total = means[k, 0] + means[k, 1] + means[k, 2] + (colors[k, 0] + colors[k, 1] + colors[k, 2])
        for i in range(3):
            total += covars[k, i, 0] + covars[k, i, 1] + covars[k, i, 2]
        if not (math.isfinite(total) and 0.0 <= opacities[k] <= 1.0):
            unusable += 1
    return unusable


@numba.njit(fastmath=FINITE_MATH_OFF, **HELPER)
def screen_covariance(means, covars, viewmat, K, k, width, height, frame):
    """Camera-space mean, M = J R and S = M Sigma M^T + 0.3 I of kernel ``k``, written to ``frame`` (float64, 22).

    Layout of ``frame``: 0..2 camera-space mean, 3..8 M row by row, 9..11 S00 S01 S11, 12..13 clamped tx ty,
    14..15 whether the clamp is inactive, 16..21 Sigma xx xy xz yy yz zz (symmetrised).
    """
    x, y, z = means[k, 0], means[k, 1], means[k, 2]
    for i in range(3):
        frame[i] = (
            np.float64(viewmat[i, 0]) * x
            + np.float64(viewmat[i, 1]) * y
            + np.float64(viewmat[i, 2]) * z
            + np.float64(viewmat[i, 3])
        )
    cx, cy, cz = frame[0], frame[1], frame[2]
    fx, fy = np.float64(K[0, 0]), np.float64(K[1, 1])
    px, py = np.float64(K[0, 2]), np.float64(K[1, 2])
    margin_x, margin_y = CLAMP_MARGIN * 0.5 * width / fx, CLAMP_MARGIN * 0.5 * height / fy
    rz = 1.0 / cz
    sx, sy = cx * rz, cy * rz
    low_x, high_x = -(px / fx + margin_x), (width - px) / fx + margin_x
    low_y, high_y = -(py / fy + margin_y), (height - py) / fy + margin_y
    qx, qy = min(max(sx, low_x), high_x), min(max(sy, low_y), high_y)
    frame[12], frame[13] = cz * qx, cz * qy
    frame[14] = 1.0 if low_x <= sx <= high_x else 0.0
    frame[15] = 1.0 if low_y <= sy <= high_y else 0.0
    j00, j02, j11, j12 = fx * rz, -fx * qx * rz, fy * rz, -fy * qy * rz
    for i in range(3):
        frame[3 + i] = j00 * viewmat[0, i] + j02 * viewmat[2, i]
        frame[6 + i] = j11 * viewmat[1, i] + j12 * viewmat[2, i]
    xx, yy, zz = np.float64(covars[k, 0, 0]), np.float64(covars[k, 1, 1]), np.float64(covars[k, 2, 2])
    xy = 0.5 * (np.float64(covars[k, 0, 1]) + covars[k, 1, 0])
    xz = 0.5 * (np.float64(covars[k, 0, 2]) + covars[k, 2, 0])
    yz = 0.5 * (np.float64(covars[k, 1, 2]) + covars[k, 2, 1])
    frame[16], frame[17], frame[18], frame[19], frame[20], frame[21] = xx, xy, xz, yy, yz, zz
    a0, a1, a2 = frame[3], frame[4], frame[5]
    b0, b1, b2 = frame[6], frame[7], frame[8]
    u0, u1, u2 = xx * a0 + xy * a1 + xz * a2, xy * a0 + yy * a1 + yz * a2, xz * a0 + yz * a1 + zz * a2
    w0, w1, w2 = xx * b0 + xy * b1 + xz * b2, xy * b0 + yy * b1 + yz * b2, xz * b0 + yz * b1 + zz * b2
    frame[9] = a0 * u0 + a1 * u1 + a2 * u2 + DILATION
    frame[10] = b0 * u0 + b1 * u1 + b2 * u2
    frame[11] = b0 * w0 + b1 * w1 + b2 * w2 + DILATION


@numba.njit(fastmath=FINITE_MATH_OFF, **KERNEL)
def project_kernels(
    means, covars, colors, opacities, viewmat, K, width, height, near, low, high, records, extents, spans, depth
):
    """Projects the kernels ``low .. high - 1`` of one state into one view; arrays are indexed by the kernel.

    ``spans`` (K, 2) receives the first and last pixel row of a kernel's ellipse, ``depth`` (K,) its depth, or -1 where
    it touches no pixel; its other rows are then not written.
    """
    frame = np.empty(22, np.float64)
    for k in range(low, high):
        o = opacities[k]
        depth[k] = np.float32(-1)
        z = (
            np.float64(viewmat[2, 0]) * means[k, 0]
            + np.float64(viewmat[2, 1]) * means[k, 1]
            + np.float64(viewmat[2, 2]) * means[k, 2]
            + np.float64(viewmat[2, 3])
        )
        if not (z > near) or o < ALPHA_MIN:
            continue
        screen_covariance(means, covars, viewmat, K, k, width, height, frame)
        s00, s01, s11 = frame[9], frame[10], frame[11]
        det = s00 * s11 - s01 * s01
        if not (det > 0.0):
            continue
        mx = K[0, 0] * frame[0] / z + K[0, 2]
        my = K[1, 1] * frame[1] / z + K[1, 2]
        t = 2.0 * math.log(255.0 * o)
        half_x, half_y = math.sqrt(t * s00), math.sqrt(t * s11)
        slack = SLACK + RELATIVE_SLACK * (half_x + half_y + abs(mx) + abs(my))
        top, bottom = my - half_y - slack - 0.5, my + half_y + slack - 0.5
        if mx + half_x < 0.0 or mx - half_x > width or bottom < 0.0 or top > height - 1.0:
            continue
        depth[k] = z
        spans[k, 0], spans[k, 1] = math.ceil(max(top, 0.0)), math.floor(min(bottom, height - 1.0))
        a, b, c = s11 / det, -s01 / det, s00 / det
        ix, iy = math.floor(mx), math.floor(my)
        records[k, 0], records[k, 1], records[k, 2], records[k, 3] = ix, mx - ix, iy, my - iy
        records[k, 4], records[k, 5], records[k, 6] = -a / 16.0, -b / 8.0, -c / 16.0
        records[k, 7] = o
        records[k, 8], records[k, 9], records[k, 10] = colors[k, 0], colors[k, 1], colors[k, 2]
        records[k, 11] = -t / 16.0
        extents[k, 0], extents[k, 1], extents[k, 2], extents[k, 3] = mx, my, half_x, slack
        extents[k, 4], extents[k, 5] = b / c, -(b / a) * half_y
        extents[k, 6], extents[k, 7] = t / c, 1.0 / (det * c * c)


@numba.njit(**KERNEL)
def depth_order(depth, spans):
    """Kernels with a depth that is not negative, near to far, and their rows of ``spans`` in this order.

    A stable radix sort on the bits of the positive floats: equal depths keep the order of the kernels.
    """
    bits = depth.view(np.int32)
    n = 0
    key, order = np.empty(depth.shape[0], np.int32), np.empty(depth.shape[0], np.int32)
    start = np.zeros((3, 2048), np.int32)
    for k in range(depth.shape[0]):
        b = bits[k]
        if b >= 0:
            key[n], order[n] = b, k
            n += 1
            for digit in range(3):
                start[digit, (b >> (11 * digit)) & 2047] += 1
    spare_key, spare = np.empty(n, np.int32), np.empty(n, np.int32)
    for digit in range(3):
        total = np.int32(0)
        for d in range(2048):
            total, start[digit, d] = total + start[digit, d], total
        for i in range(n):
            d = (key[i] >> (11 * digit)) & 2047
            at = start[digit, d]
            start[digit, d] = at + 1
            spare_key[at], spare[at] = key[i], order[i]
        key, spare_key, order, spare = spare_key, key, spare, order
    sorted_spans = np.empty((n, 2), np.int32)
    for i in range(n):
        sorted_spans[i, 0], sorted_spans[i, 1] = spans[order[i], 0], spans[order[i], 1]
    return order[:n], sorted_spans


@numba.njit(fastmath=True, **HELPER)
def gather_sums(low, high, depth, spans, band_of, row_of, offsets, sums, totals):
    """Sums of the kernels ``low .. high - 1`` over the bands, in the order of the bands, written to ``totals``.

    A separate loop, because its reads are scattered over more memory than the caches have: many can overlap.
    """
    for k in range(low, high):
        for j in range(SUMS):
            totals[k - low, j] = ZERO
        if depth[k] >= 0.0:
            for i in range(band_of[spans[k, 0]], band_of[spans[k, 1]] + 1):
                row = offsets[i] + row_of[i, k]
                for j in range(SUMS):
                    totals[k - low, j] += sums[row, j]


@numba.njit(fastmath=True, **KERNEL)
def project_adjoint(
    means, covars, opacities, viewmat, K, width, height, low, high, depth, spans, band_of, row_of, offsets, sums,
    grad_means, grad_covars, grad_opacities, grad_colors,
):  # fmt: skip
    """Adds one view's part to the loss gradients of the kernels ``low .. high - 1``, from its sums over pixels.

    ``depth`` (K,) and ``spans`` (K, 2) come from project_kernels; pixel row y lies in band ``band_of[y]``. In band i
    kernel k has the row ``offsets[i] + row_of[i, k]`` of ``sums``. ``grad_colors`` are of this view alone and are
    overwritten.

    With m0, m1, m11, m2, m12, m22 the sums over pixels of s, s dx, ..: dL/do = m0 / o, dL/dmean2d = Q (m1, m2),
    G_Q = -1/2 [[m11, m12], [m12, m22]], G_S = -Q G_Q Q, dL/dSigma = M^T G_S M, dL/dM = 2 G_S M Sigma, then through J.
    """
    frame, totals = np.empty(22, np.float64), np.empty((AT_ONCE, SUMS), np.float32)
    grad_row0, grad_row1 = np.empty(3, np.float64), np.empty(3, np.float64)
    for k in range(low, high):
        if (k - low) % AT_ONCE == 0:
            gather_sums(k, min(k + AT_ONCE, high), depth, spans, band_of, row_of, offsets, sums, totals)
        total = totals[(k - low) % AT_ONCE]
        grad_colors[k, 0], grad_colors[k, 1], grad_colors[k, 2] = total[S_RED], total[S_GREEN], total[S_BLUE]
        if depth[k] < 0.0:
            continue
        screen_covariance(means, covars, viewmat, K, k, width, height, frame)
        m0, m1, m11 = np.float64(total[S]), np.float64(total[S_X]), np.float64(total[S_XX])
        m2, m12, m22 = np.float64(total[S_Y]), np.float64(total[S_XY]), np.float64(total[S_YY])
        s00, s01, s11 = frame[9], frame[10], frame[11]
        rdet = 1.0 / (s00 * s11 - s01 * s01)
        a, b, c = s11 * rdet, -s01 * rdet, s00 * rdet
        grad_opacities[k] += m0 / opacities[k]
        gu, gv = a * m1 + b * m2, b * m1 + c * m2
        # G_S = 1/2 Q [[m11, m12], [m12, m22]] Q
        t00, t01 = a * m11 + b * m12, a * m12 + b * m22
        t10, t11 = b * m11 + c * m12, b * m12 + c * m22
        g00, g01, g11 = 0.5 * (t00 * a + t01 * b), 0.5 * (t00 * b + t01 * c), 0.5 * (t10 * b + t11 * c)
        xx, xy, xz, yy, yz, zz = frame[16], frame[17], frame[18], frame[19], frame[20], frame[21]
        for j in range(3):
            p, q = g00 * frame[3 + j] + g01 * frame[6 + j], g01 * frame[3 + j] + g11 * frame[6 + j]
            grad_row0[j], grad_row1[j] = p, q
            for h in range(3):
                grad_covars[k, h, j] += frame[3 + h] * p + frame[6 + h] * q
        p0, p1, p2 = grad_row0[0], grad_row0[1], grad_row0[2]
        q0, q1, q2 = grad_row1[0], grad_row1[1], grad_row1[2]
        # dL/dM = 2 G_S M Sigma; of dL/dJ = dL/dM R^T only the four entries that J has are needed.
        n0, n1, n2 = (
            2 * (p0 * xx + p1 * xy + p2 * xz),
            2 * (p0 * xy + p1 * yy + p2 * yz),
            2 * (p0 * xz + p1 * yz + p2 * zz),
        )
        o0, o1, o2 = (
            2 * (q0 * xx + q1 * xy + q2 * xz),
            2 * (q0 * xy + q1 * yy + q2 * yz),
            2 * (q0 * xz + q1 * yz + q2 * zz),
        )
        j00 = n0 * viewmat[0, 0] + n1 * viewmat[0, 1] + n2 * viewmat[0, 2]
        j02 = n0 * viewmat[2, 0] + n1 * viewmat[2, 1] + n2 * viewmat[2, 2]
        j11 = o0 * viewmat[1, 0] + o1 * viewmat[1, 1] + o2 * viewmat[1, 2]
        j12 = o0 * viewmat[2, 0] + o1 * viewmat[2, 1] + o2 * viewmat[2, 2]
        rz = 1.0 / frame[2]
        ex, ey = K[0, 0] * rz, K[1, 1] * rz
        qx, qy = frame[12] * rz, frame[13] * rz
        free_x, free_y = frame[14], frame[15]
        cam_x = ex * gu - free_x * ex * rz * j02
        cam_y = ey * gv - free_y * ey * rz * j12
        cam_z = -ex * frame[0] * rz * gu - ey * frame[1] * rz * gv
        cam_z += ex * rz * (qx * (1.0 + free_x) * j02 - j00) + ey * rz * (qy * (1.0 + free_y) * j12 - j11)
        for j in range(3):
            grad_means[k, j] += cam_x * viewmat[0, j] + cam_y * viewmat[1, j] + cam_z * viewmat[2, j]
