"""Covariances and view-dependent colours of deformed kernels, one after the other, and their adjoints."""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"
import math

import numba
import numpy as np

from gausim.kernels.jit import HELPER, KERNEL
from gausim.ops import spherical_harmonics

ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
THREE, FOUR, SIX, EIGHT = np.float32(3), np.float32(4), np.float32(6), np.float32(8)
SMALLEST_NORM = np.float32(1e-12)  # torch.nn.functional.normalize
C0, C1 = np.float32(spherical_harmonics.C0), np.float32(spherical_harmonics.C1)
C20, C21, C22, C23, C24 = (np.float32(c) for c in spherical_harmonics.C2)
C30, C31, C32, C33, C34, C35, C36 = (np.float32(c) for c in spherical_harmonics.C3)


@numba.njit(fastmath=True, **HELPER)
def write_basis(x, y, z, degree, basis):
    """The (degree + 1)^2 spherical harmonics of a unit vector into ``basis`` (ops.spherical_harmonics)."""
    basis[0] = C0
    if degree > 0:
        basis[1], basis[2], basis[3] = y * -C1, z * C1, x * -C1
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        basis[4], basis[5], basis[6] = x * y * C20, y * z * C21, (zz * TWO - xx - yy) * C22
        basis[7], basis[8] = x * z * C23, (xx - yy) * C24
        if degree > 2:
            basis[9], basis[10] = y * (xx * THREE - yy) * C30, x * y * z * C31
            basis[11], basis[12] = y * (zz * FOUR - xx - yy) * C32, z * (zz * TWO - (xx + yy) * THREE) * C33
            basis[13], basis[14] = x * (zz * FOUR - xx - yy) * C34, z * (xx - yy) * C35
            basis[15] = x * (xx - yy * THREE) * C36


@numba.njit(fastmath=True, **HELPER)
def basis_adjoint(x, y, z, degree, w):
    """Loss gradient of the direction from that of the basis, ``w``."""
    gx, gy, gz = ZERO, ZERO, ZERO
    if degree > 0:
        gx, gy, gz = w[3] * -C1, w[1] * -C1, w[2] * C1
    if degree > 1:
        w4, w5, w6, w7, w8 = w[4] * C20, w[5] * C21, w[6] * (C22 + C22), w[7] * C23, w[8] * (C24 + C24)
        gx += w4 * y - w6 * x + w7 * z + w8 * x
        gy += w4 * x + w5 * z - w6 * y - w8 * y
        gz += w5 * y + w6 * z * TWO + w7 * x
        if degree > 2:
            xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
            a, b, c, d = w[9] * C30, w[10] * C31, w[11] * C32, w[12] * C33
            e, f, g = w[13] * C34, w[14] * C35, w[15] * C36
            turn = (xx - yy) * THREE
            gx += a * xy * SIX + b * yz - c * xy * TWO - d * xz * SIX
            gx += e * (zz * FOUR - xx * THREE - yy) + f * xz * TWO + g * turn
            gy += a * turn + b * xz + c * (zz * FOUR - xx - yy * THREE) - d * yz * SIX
            gy -= e * xy * TWO + f * yz * TWO + g * xy * SIX
            gz += b * xy + c * yz * EIGHT + d * (zz * SIX - (xx + yy) * THREE) + e * xz * EIGHT + f * (xx - yy)
    return gx, gy, gz


@numba.njit(fastmath=True, **HELPER)
def direction(positions, k, centers, v, rotations, c):
    """Unit vector d from camera v to kernel k of unit c, Q^T d (in its rest frame), and one over the distance."""
    x, y, z = positions[k, 0] - centers[v, 0], positions[k, 1] - centers[v, 1], positions[k, 2] - centers[v, 2]
    inverse = ONE / max(np.float32(math.sqrt(x * x + y * y + z * z)), SMALLEST_NORM)
    x, y, z = x * inverse, y * inverse, z * inverse
    tx = rotations[c, 0, 0] * x + rotations[c, 1, 0] * y + rotations[c, 2, 0] * z
    ty = rotations[c, 0, 1] * x + rotations[c, 1, 1] * y + rotations[c, 2, 1] * z
    tz = rotations[c, 0, 2] * x + rotations[c, 1, 2] * y + rotations[c, 2, 2] * z
    return x, y, z, tx, ty, tz, inverse


@numba.njit(fastmath=True, **HELPER)
def colors_of(basis, sh, k):
    """0.5 + sum_b basis_b sh_kb of the three channels."""
    red, green, blue = HALF, HALF, HALF
    for b in range(sh.shape[1]):
        red += basis[b] * sh[k, b, 0]
        green += basis[b] * sh[k, b, 1]
        blue += basis[b] * sh[k, b, 2]
    return red, green, blue


# Kernels are given by index: a view of an array counts its references, which costs more than the arithmetic.
@numba.njit(fastmath=True, **KERNEL)
def shade(
    first, end, positions, deformation_gradients, rotations, unit, rest, sh, degree, centers, out_covars, out_colors
):
    """Covariances (K, 3, 3) and colours (V, K, 3) of one state's kernels ``first .. end - 1``."""
    basis, half, g = np.empty(16, np.float32), np.empty((3, 3), np.float32), deformation_gradients
    for k in range(first, end):
        c = unit[k]
        for i in range(3):
            for j in range(3):
                half[i, j] = g[c, i, 0] * rest[k, 0, j] + g[c, i, 1] * rest[k, 1, j] + g[c, i, 2] * rest[k, 2, j]
        for i in range(3):
            for j in range(3):
                out_covars[k, i, j] = half[i, 0] * g[c, j, 0] + half[i, 1] * g[c, j, 1] + half[i, 2] * g[c, j, 2]
        for v in range(centers.shape[0]):
            _, _, _, x, y, z, _ = direction(positions, k, centers, v, rotations, c)
            write_basis(x, y, z, degree, basis)
            red, green, blue = colors_of(basis, sh, k)
            out_colors[v, k, 0], out_colors[v, k, 1] = max(red, ZERO), max(green, ZERO)
            out_colors[v, k, 2] = max(blue, ZERO)


@numba.njit(fastmath=True, **HELPER)
def view_adjoint(k, v, c, positions, rotations, sh, degree, centers, grad_colors, basis, total):
    """Adds view v's loss gradients of the position and rotation of kernel k of unit c to ``total`` (12,)."""
    dx, dy, dz, x, y, z, inverse = direction(positions, k, centers, v, rotations, c)
    write_basis(x, y, z, degree, basis)
    red, green, blue = colors_of(basis, sh, k)
    red = grad_colors[v, k, 0] if red >= ZERO else ZERO
    green = grad_colors[v, k, 1] if green >= ZERO else ZERO
    blue = grad_colors[v, k, 2] if blue >= ZERO else ZERO
    for b in range(sh.shape[1]):
        basis[b] = sh[k, b, 0] * red + sh[k, b, 1] * green + sh[k, b, 2] * blue
    x, y, z = basis_adjoint(x, y, z, degree, basis)
    # With t = Q^T d: dL/dQ_ij = d_i t_j, dL/dd_i = sum_j Q_ij t_j.
    total[3] += dx * x
    total[4] += dx * y
    total[5] += dx * z
    total[6] += dy * x
    total[7] += dy * y
    total[8] += dy * z
    total[9] += dz * x
    total[10] += dz * y
    total[11] += dz * z
    tx = rotations[c, 0, 0] * x + rotations[c, 0, 1] * y + rotations[c, 0, 2] * z
    ty = rotations[c, 1, 0] * x + rotations[c, 1, 1] * y + rotations[c, 1, 2] * z
    tz = rotations[c, 2, 0] * x + rotations[c, 2, 1] * y + rotations[c, 2, 2] * z
    radial = dx * tx + dy * ty + dz * tz
    total[0] += (tx - dx * radial) * inverse
    total[1] += (ty - dy * radial) * inverse
    total[2] += (tz - dz * radial) * inverse


@numba.njit(fastmath=True, **HELPER)
def covariance_adjoint(k, c, g, rest, h, left, right, grad_g):
    """Adds dL/dG = H G S^T + H^T G S of kernel k, with H the loss gradient of its covariance, to its unit c."""
    for i in range(3):
        for j in range(3):
            left[i, j] = g[c, i, 0] * rest[k, j, 0] + g[c, i, 1] * rest[k, j, 1] + g[c, i, 2] * rest[k, j, 2]
            right[i, j] = g[c, i, 0] * rest[k, 0, j] + g[c, i, 1] * rest[k, 1, j] + g[c, i, 2] * rest[k, 2, j]
    for i in range(3):
        for j in range(3):
            both = h[k, i, 0] * left[0, j] + h[k, i, 1] * left[1, j] + h[k, i, 2] * left[2, j]
            both += h[k, 0, i] * right[0, j] + h[k, 1, i] * right[1, j] + h[k, 2, i] * right[2, j]
            grad_g[c, i, j] += both


@numba.njit(fastmath=True, **KERNEL)
def shade_adjoint(
    first, end, positions, deformation_gradients, rotations, unit, rest, sh, degree, centers,
    grad_covars, grad_colors, grad_positions, grad_deformation_gradients, grad_rotations,
):  # fmt: skip
    """Adjoint of :func:`shade`: writes ``grad_positions`` and adds to the loss gradients of the units."""
    basis, total = np.empty(16, np.float32), np.empty(12, np.float32)
    left, right = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
    for k in range(first, end):
        c = unit[k]
        covariance_adjoint(k, c, deformation_gradients, rest, grad_covars, left, right, grad_deformation_gradients)
        total[:] = ZERO
        for v in range(centers.shape[0]):
            view_adjoint(k, v, c, positions, rotations, sh, degree, centers, grad_colors, basis, total)
        for i in range(3):
            grad_positions[k, i] = total[i]
            for j in range(3):
                grad_rotations[c, i, j] += total[3 + 3 * i + j]
