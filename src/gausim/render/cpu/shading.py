"""Covariances and view-dependent colours of deformed kernels, sixteen at a time, and their adjoints.

``lanes`` has one vector for each number of sixteen kernels: the mean (P), the deformation gradient (G) and rotation (Q)
of the kernel's unit, then results. ``rest`` (blocks, 9, 16) and ``coefficients`` (blocks, 3 basis, 16) are the rest
covariances and colour coefficients of blocks of sixteen kernels in the same form; the last block is padded.
"""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"
from __future__ import annotations

import numba
import numpy as np

from gausim.kernels.jit import HELPER, KERNEL
from gausim.ops import spherical_harmonics
from gausim.render.cpu.simd import LANES, load, maximum, select, splat, square_root, store

P, G, Q, OUT = 0, 3 * LANES, 12 * LANES, 21 * LANES  # positions in ``lanes`` where the parts start
LANES_SIZE = OUT + 21 * LANES
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
THREE, FOUR, SIX, EIGHT = np.float32(3), np.float32(4), np.float32(6), np.float32(8)
SMALLEST_NORM = np.float32(1e-12)  # torch.nn.functional.normalize
C0, C1 = np.float32(spherical_harmonics.C0), np.float32(spherical_harmonics.C1)
C20, C21, C22, C23, C24 = (np.float32(c) for c in spherical_harmonics.C2)
C30, C31, C32, C33, C34, C35, C36 = (np.float32(c) for c in spherical_harmonics.C3)


@numba.njit(fastmath=True, **HELPER)
def gather(base, positions, deformation_gradients, rotations, unit, lanes):
    """Fills P, G and Q for the sixteen kernels from ``base`` on; the last kernel is repeated beyond the end."""
    for j in range(LANES):
        k = min(base + j, positions.shape[0] - 1)
        for i in range(3):
            lanes[P + i * LANES + j] = positions[k, i]
            for h in range(3):
                lanes[G + (3 * i + h) * LANES + j] = deformation_gradients[unit[k], i, h]
                lanes[Q + (3 * i + h) * LANES + j] = rotations[unit[k], i, h]


@numba.njit(fastmath=True, **HELPER)
def write_basis(x, y, z, degree, basis):
    """The (degree + 1)^2 spherical harmonics of unit vectors into ``basis`` (ops.spherical_harmonics)."""
    store(basis, 0, splat(C0))
    if degree > 0:
        store(basis, LANES, y * -C1)
        store(basis, 2 * LANES, z * C1)
        store(basis, 3 * LANES, x * -C1)
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        store(basis, 4 * LANES, x * y * C20)
        store(basis, 5 * LANES, y * z * C21)
        store(basis, 6 * LANES, (zz * TWO - xx - yy) * C22)
        store(basis, 7 * LANES, x * z * C23)
        store(basis, 8 * LANES, (xx - yy) * C24)
        if degree > 2:
            store(basis, 9 * LANES, y * (xx * THREE - yy) * C30)
            store(basis, 10 * LANES, x * y * z * C31)
            store(basis, 11 * LANES, y * (zz * FOUR - xx - yy) * C32)
            store(basis, 12 * LANES, z * (zz * TWO - (xx + yy) * THREE) * C33)
            store(basis, 13 * LANES, x * (zz * FOUR - xx - yy) * C34)
            store(basis, 14 * LANES, z * (xx - yy) * C35)
            store(basis, 15 * LANES, x * (xx - yy * THREE) * C36)


@numba.njit(fastmath=True, **HELPER)
def basis_adjoint(x, y, z, degree, w):
    """Loss gradient of the direction from that of the basis, ``w``."""
    gx, gy, gz = splat(ZERO), splat(ZERO), splat(ZERO)
    if degree > 0:
        gy = load(w, LANES) * -C1
        gz = load(w, 2 * LANES) * C1
        gx = load(w, 3 * LANES) * -C1
    if degree > 1:
        w4, w5, w6 = load(w, 4 * LANES) * C20, load(w, 5 * LANES) * C21, load(w, 6 * LANES) * (C22 + C22)
        w7, w8 = load(w, 7 * LANES) * C23, load(w, 8 * LANES) * (C24 + C24)
        gx += w4 * y - w6 * x + w7 * z + w8 * x
        gy += w4 * x + w5 * z - w6 * y - w8 * y
        gz += w5 * y + w6 * z * TWO + w7 * x
        if degree > 2:
            xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
            a, b, c = load(w, 9 * LANES) * C30, load(w, 10 * LANES) * C31, load(w, 11 * LANES) * C32
            d, e = load(w, 12 * LANES) * C33, load(w, 13 * LANES) * C34
            f, g = load(w, 14 * LANES) * C35, load(w, 15 * LANES) * C36
            turn = (xx - yy) * THREE
            gx += a * xy * SIX + b * yz - c * xy * TWO - d * xz * SIX
            gx += e * (zz * FOUR - xx * THREE - yy) + f * xz * TWO + g * turn
            gy += a * turn + b * xz + c * (zz * FOUR - xx - yy * THREE) - d * yz * SIX
            gy -= e * xy * TWO + f * yz * TWO + g * xy * SIX
            gz += b * xy + c * yz * EIGHT + d * (zz * SIX - (xx + yy) * THREE) + e * xz * EIGHT + f * (xx - yy)
    return gx, gy, gz


@numba.njit(fastmath=True, **HELPER)
def direction(lanes, center):
    """Unit vectors d from a camera to the kernels, Q^T d (in the kernels' rest frame), and one over the distance."""
    x, y, z = load(lanes, P) - center[0], load(lanes, P + LANES) - center[1], load(lanes, P + 2 * LANES) - center[2]
    inverse = ONE / maximum(square_root(x * x + y * y + z * z), SMALLEST_NORM)
    x, y, z = x * inverse, y * inverse, z * inverse
    tx = load(lanes, Q) * x + load(lanes, Q + 3 * LANES) * y + load(lanes, Q + 6 * LANES) * z
    ty = load(lanes, Q + LANES) * x + load(lanes, Q + 4 * LANES) * y + load(lanes, Q + 7 * LANES) * z
    tz = load(lanes, Q + 2 * LANES) * x + load(lanes, Q + 5 * LANES) * y + load(lanes, Q + 8 * LANES) * z
    return x, y, z, tx, ty, tz, inverse


@numba.njit(fastmath=True, **HELPER)
def colours(basis, count, block):
    """0.5 + sum_b basis_b coefficient_b of the three channels; ``block`` = coefficients of sixteen kernels."""
    red, green, blue = splat(HALF), splat(HALF), splat(HALF)
    for b in range(count):
        y = load(basis, b * LANES)
        red += y * load(block, 3 * b * LANES)
        green += y * load(block, (3 * b + 1) * LANES)
        blue += y * load(block, (3 * b + 2) * LANES)
    return red, green, blue


@numba.njit(fastmath=True, **HELPER)
def product(a, at, b, bt, step, stride, out, to):
    """out_ij = sum_k a_ik b(k, j), 3 x 3 matrices in lanes; b(k, j) at ``bt`` + (k ``step`` + j ``stride``) vectors."""
    for i in range(3):
        for j in range(3):
            total = load(a, at + 3 * i * LANES) * load(b, bt + j * stride * LANES)
            total += load(a, at + (3 * i + 1) * LANES) * load(b, bt + (step + j * stride) * LANES)
            total += load(a, at + (3 * i + 2) * LANES) * load(b, bt + (2 * step + j * stride) * LANES)
            store(out, to + (3 * i + j) * LANES, total)


@numba.njit(fastmath=True, **KERNEL)
def shade(
    first,
    end,
    positions,
    deformation_gradients,
    rotations,
    unit,
    rest,
    coefficients,
    degree,
    centers,
    out_covars,
    out_colors,
):
    """Covariances (K, 3, 3) and colours (V, K, 3) of one state's kernels in the blocks ``first .. end - 1``."""
    lanes, basis = np.empty(LANES_SIZE, np.float32), np.empty(16 * LANES, np.float32)
    for block in range(first, end):
        base = block * LANES
        n = min(LANES, positions.shape[0] - base)
        gather(base, positions, deformation_gradients, rotations, unit, lanes)
        product(lanes, G, rest[block].reshape(-1), 0, 3, 1, lanes, OUT)
        product(lanes, OUT, lanes, G, 1, 3, lanes, OUT + 9 * LANES)
        for j in range(n):
            for i in range(9):
                out_covars[base + j, i // 3, i % 3] = lanes[OUT + (9 + i) * LANES + j]
        for v in range(centers.shape[0]):
            _, _, _, x, y, z, _ = direction(lanes, centers[v])
            write_basis(x, y, z, degree, basis)
            red, green, blue = colours(basis, (degree + 1) ** 2, coefficients[block].reshape(-1))
            store(lanes, OUT, maximum(red, ZERO))
            store(lanes, OUT + LANES, maximum(green, ZERO))
            store(lanes, OUT + 2 * LANES, maximum(blue, ZERO))
            for j in range(n):
                for i in range(3):
                    out_colors[v, base + j, i] = lanes[OUT + i * LANES + j]


@numba.njit(fastmath=True, **HELPER)
def view_adjoint(lanes, center, degree, block, basis, grad_color):
    """Adds one view's loss gradients of P and Q to those from OUT on; ``block`` as for :func:`colours`."""
    dx, dy, dz, x, y, z, inverse = direction(lanes, center)
    write_basis(x, y, z, degree, basis)
    count = (degree + 1) ** 2
    red, green, blue = colours(basis, count, block)
    red = select(red >= ZERO, load(grad_color, 0), ZERO)
    green = select(green >= ZERO, load(grad_color, LANES), ZERO)
    blue = select(blue >= ZERO, load(grad_color, 2 * LANES), ZERO)
    for b in range(count):
        at = 3 * b * LANES
        w = load(block, at) * red + load(block, at + LANES) * green + load(block, at + 2 * LANES) * blue
        store(basis, b * LANES, w)
    x, y, z = basis_adjoint(x, y, z, degree, basis)
    store(basis, 0, dx)
    store(basis, LANES, dy)
    store(basis, 2 * LANES, dz)
    for i in range(3):  # d Q_ij: d_i t_j; d d_i = sum_j Q_ij t_j
        d, at, to = load(basis, i * LANES), Q + 3 * i * LANES, OUT + (3 + 3 * i) * LANES
        store(lanes, to, load(lanes, to) + d * x)
        store(lanes, to + LANES, load(lanes, to + LANES) + d * y)
        store(lanes, to + 2 * LANES, load(lanes, to + 2 * LANES) + d * z)
        along = load(lanes, at) * x + load(lanes, at + LANES) * y + load(lanes, at + 2 * LANES) * z
        store(basis, (3 + i) * LANES, along)
    x, y, z = load(basis, 3 * LANES), load(basis, 4 * LANES), load(basis, 5 * LANES)
    radial = dx * x + dy * y + dz * z
    store(lanes, OUT, load(lanes, OUT) + (x - dx * radial) * inverse)
    store(lanes, OUT + LANES, load(lanes, OUT + LANES) + (y - dy * radial) * inverse)
    store(lanes, OUT + 2 * LANES, load(lanes, OUT + 2 * LANES) + (z - dz * radial) * inverse)


@numba.njit(fastmath=True, **HELPER)
def covariance_adjoint(lanes, covar, grad_covar, work):
    """dL/dG = H G S^T + H^T G S into the last nine of ``lanes``."""
    product(lanes, G, covar, 0, 3, 1, work, 0)  # G S
    product(lanes, G, covar, 0, 1, 3, work, 9 * LANES)  # G S^T
    for i in range(3):
        for j in range(3):
            total = splat(ZERO)
            for k in range(3):
                total += load(grad_covar, (3 * i + k) * LANES) * load(work, (9 + 3 * k + j) * LANES)
                total += load(grad_covar, (3 * k + i) * LANES) * load(work, (3 * k + j) * LANES)
            store(lanes, OUT + (12 + 3 * i + j) * LANES, total)


@numba.njit(fastmath=True, **KERNEL)
def shade_adjoint(
    first, end, positions, deformation_gradients, rotations, unit, rest, coefficients, degree, centers,
    grad_covars, grad_colors, grad_positions, grad_deformation_gradients, grad_rotations,
):  # fmt: skip
    """Adjoint of :func:`shade`: writes ``grad_positions`` and adds to the loss gradients of the units."""
    lanes, basis = np.empty(LANES_SIZE, np.float32), np.empty(16 * LANES, np.float32)
    grad, work = np.empty(9 * LANES, np.float32), np.empty(18 * LANES, np.float32)
    for block in range(first, end):
        base = block * LANES
        n = min(LANES, positions.shape[0] - base)
        gather(base, positions, deformation_gradients, rotations, unit, lanes)
        lanes[OUT:] = ZERO
        for j in range(LANES):
            k = min(base + j, positions.shape[0] - 1)
            for i in range(9):
                grad[i * LANES + j] = grad_covars[k, i // 3, i % 3]
        covariance_adjoint(lanes, rest[block].reshape(-1), grad, work)
        for v in range(centers.shape[0]):
            for j in range(LANES):
                k = min(base + j, positions.shape[0] - 1)
                for i in range(3):
                    grad[i * LANES + j] = grad_colors[v, k, i]
            view_adjoint(lanes, centers[v], degree, coefficients[block].reshape(-1), basis, grad)
        for j in range(n):
            c = unit[base + j]
            for i in range(3):
                grad_positions[base + j, i] = lanes[OUT + i * LANES + j]
            for i in range(9):
                grad_rotations[c, i // 3, i % 3] += lanes[OUT + (3 + i) * LANES + j]
                grad_deformation_gradients[c, i // 3, i % 3] += lanes[OUT + (12 + i) * LANES + j]
