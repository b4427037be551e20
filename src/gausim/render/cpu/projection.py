"""Projection of Gaussians into one view, and their order by depth."""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import math

import numba
import numpy as np

# All of fastmath but nnan and ninf: what overflows here must not turn into an undefined index later.
FINITE_MATH_OFF = {"contract", "reassoc", "arcp", "nsz", "afn"}

# Raster record, float32: integer and fractional part of the mean, x then y (so that offsets inside a tile stay exact
# far from the image's origin), -A/16, -B/8, -C/16 of the inverse covariance, opacity, colour, and the exponent below
# which alpha < 1/255, over 8.
RECORD = 12
# Extent record, float64: mean x y, half width X, half height Y, B/C, -(B/A) Y, t/C, det Q / C^2.
EXTENT = 8

DILATION = 0.3  # [pixels^2], gsplat's and 3DGS's low-pass filter
ALPHA_MIN = 1.0 / 255.0
CLAMP_MARGIN = 0.3  # gsplat clamps x/z and y/z to the field of view widened by this fraction


@numba.njit(nogil=True, error_model="numpy", cache=True)
def count_unusable(means, covars, colors, opacities):
    """Number of kernels that are not finite or whose opacity lies outside 0..1 (no fastmath: it would see no NaN)."""
    unusable = 0
    for k in range(means.shape[0]):
        total = np.float64(0)
        for i in range(3):
            total += np.float64(means[k, i]) + colors[k, i] + covars[k, i, 0] + covars[k, i, 1] + covars[k, i, 2]
        if not (math.isfinite(total) and 0.0 <= opacities[k] <= 1.0):
            unusable += 1
    return unusable


@numba.njit(nogil=True, fastmath=FINITE_MATH_OFF, error_model="numpy", cache=True, inline="always")
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


@numba.njit(nogil=True, fastmath=FINITE_MATH_OFF, error_model="numpy", cache=True)
def project_view(means, covars, colors, opacities, viewmat, K, width, height, near):
    """Projects all kernels of one state into one view and drops those that cannot touch a pixel.

    Returns:
        records (n, RECORD), extents (n, EXTENT), kernel index (n,) and depth (n,) of the n kernels left, in kernel
        order.
    """
    count = means.shape[0]
    records = np.empty((count, RECORD), np.float32)
    extents = np.empty((count, EXTENT), np.float64)
    ids = np.empty(count, np.int32)
    depth = np.empty(count, np.float32)
    frame = np.empty(22, np.float64)
    n = 0
    for k in range(count):
        o = opacities[k]
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
        if mx + half_x < 0.0 or mx - half_x > width or my + half_y < 0.0 or my - half_y > height:
            continue
        a, b, c = s11 / det, -s01 / det, s00 / det
        ix, iy = math.floor(mx), math.floor(my)
        records[n, 0], records[n, 1], records[n, 2], records[n, 3] = ix, mx - ix, iy, my - iy
        records[n, 4], records[n, 5], records[n, 6] = -a / 16.0, -b / 8.0, -c / 16.0
        records[n, 7] = o
        records[n, 8], records[n, 9], records[n, 10] = colors[k, 0], colors[k, 1], colors[k, 2]
        records[n, 11] = -t / 16.0
        extents[n, 0], extents[n, 1], extents[n, 2], extents[n, 3] = mx, my, half_x, half_y
        extents[n, 4], extents[n, 5] = b / c, -(b / a) * half_y
        extents[n, 6], extents[n, 7] = t / c, 1.0 / (det * c * c)
        ids[n], depth[n] = k, z
        n += 1
    return records, extents, ids[:n], depth[:n]


@numba.njit(nogil=True, error_model="numpy", cache=True)
def depth_order(depth):
    """Stable order of positive depths, near to far: a radix sort on the bits (equal depths keep the kernel order)."""
    n = depth.shape[0]
    key, spare_key = depth.view(np.uint32).copy(), np.empty(n, np.uint32)
    order, spare = np.arange(n).astype(np.int32), np.empty(n, np.int32)
    start = np.empty(2048, np.int32)
    for shift in (0, 11, 22):
        start[:] = 0
        for i in range(n):
            start[(key[i] >> np.uint32(shift)) & np.uint32(2047)] += 1
        total = 0
        for d in range(2048):
            total, start[d] = total + start[d], total
        for i in range(n):
            d = (key[i] >> np.uint32(shift)) & np.uint32(2047)
            at = start[d]
            start[d] = at + 1
            spare_key[at], spare[at] = key[i], order[i]
        key, spare_key, order, spare = spare_key, key, spare, order
    return order


@numba.njit(nogil=True, fastmath=True, error_model="numpy", cache=True)
def add_band_sums(total, sums, row_of, first):
    """Adds one band's sums to those of the projected kernels ``first .. first + len(total)``."""
    for i in range(total.shape[0]):
        row = row_of[first + i]
        if row >= 0:
            for j in range(total.shape[1]):
                total[i, j] += sums[row, j]


@numba.njit(nogil=True, fastmath=True, error_model="numpy", cache=True)
def project_adjoint(
    means, covars, opacities, viewmat, K, width, height, ids, total, grad_means, grad_covars, grad_opacities
):
    """Takes one view's image-space sums back to the kernels ``ids`` and adds them to their gradients.

    With m0, m1, m11, m2, m12, m22 the sums over pixels of s, s dx, ..: dL/do = m0 / o, dL/dmean2d = Q (m1, m2),
    G_Q = -1/2 [[m11, m12], [m12, m22]], G_S = -Q G_Q Q, dL/dSigma = M^T G_S M, dL/dM = 2 G_S M Sigma, then through J.
    """
    frame = np.empty(22, np.float64)
    grad_row0, grad_row1 = np.empty(3, np.float64), np.empty(3, np.float64)
    for i in range(ids.shape[0]):
        k = ids[i]
        screen_covariance(means, covars, viewmat, K, k, width, height, frame)
        m0, m1, m11 = np.float64(total[i, 0]), np.float64(total[i, 1]), np.float64(total[i, 2])
        m2, m12, m22 = np.float64(total[i, 3]), np.float64(total[i, 4]), np.float64(total[i, 5])
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
