"""Fast forms of the operations of :mod:`gausim.ops.deformation`."""

# The kernels carry no annotations: numba has to compile them as they are.
# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from gausim.kernels.constants import MAX_LOG_STRETCH, POLAR_ITERATIONS
from gausim.kernels.jit import HELPER, KERNEL, ORDERED
from gausim.kernels.operations import array

ONE, TWO, HALF, THIRD = np.float32(1), np.float32(2), np.float32(0.5), np.float32(1 / 3)
SMALLEST_NORM = np.float32(1e-12)  # torch.nn.functional.normalize

LIMIT = np.float32(MAX_LOG_STRETCH)


@numba.njit(fastmath=ORDERED, **HELPER)
def _rotation(output, i, column, quat, matrix):
    """Unit quaternion and matrix of the numbers ``column`` .. + 3 of row ``i``; returns one over their length."""
    w, x, y, z = output[i, column] + ONE, output[i, column + 1], output[i, column + 2], output[i, column + 3]
    length = math.sqrt(w * w + x * x + y * y + z * z)
    inverse = ONE / (SMALLEST_NORM if length < SMALLEST_NORM else length)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    quat[0], quat[1], quat[2], quat[3] = w, x, y, z
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)
    return inverse


@numba.njit(fastmath=ORDERED, **HELPER)
def _rotation_adjoint(quat, inverse, g, grad, i, column):
    """Gradient of the four numbers from the gradient ``g`` of the matrix."""
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    gw = TWO * (z * (g[1, 0] - g[0, 1]) + y * (g[0, 2] - g[2, 0]) + x * (g[2, 1] - g[1, 2]))
    gx = TWO * (
        y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2]) - TWO * x * (g[1, 1] + g[2, 2])
    )
    gy = TWO * (
        x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]) - TWO * y * (g[0, 0] + g[2, 2])
    )
    gz = TWO * (
        x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1]) - TWO * z * (g[0, 0] + g[1, 1])
    )
    along = w * gw + x * gx + y * gy + z * gz
    grad[i, column] = (gw - along * w) * inverse
    grad[i, column + 1] = (gx - along * x) * inverse
    grad[i, column + 2] = (gy - along * y) * inverse
    grad[i, column + 3] = (gz - along * z) * inverse


@numba.njit(fastmath=ORDERED, **HELPER)
def _stretches(output, i, limit, conserve, stretch):
    mean = np.float32(0)
    for k in range(3):
        value = output[i, 8 + k]
        if value > limit:
            value = limit
        elif value < -limit:
            value = -limit
        stretch[k] = value  # NaN stays NaN
        mean += THIRD * value
    for k in range(3):
        if conserve:
            stretch[k] -= mean
        stretch[k] = math.exp(stretch[k])


@numba.njit(fastmath=ORDERED, **KERNEL)
def _gradients(output, limit, conserve, gradient, rotation):
    quat, stretch = np.empty(4, np.float32), np.empty(3, np.float32)
    u, v = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
    for i in range(output.shape[0]):
        _rotation(output, i, 0, quat, u)
        _rotation(output, i, 4, quat, v)
        _stretches(output, i, limit, conserve, stretch)
        for a in range(3):
            for b in range(3):
                p0, p1, p2 = u[a, 0] * v[b, 0], u[a, 1] * v[b, 1], u[a, 2] * v[b, 2]
                rotation[i, a, b] = p0 + p1 + p2
                gradient[i, a, b] = p0 * stretch[0] + p1 * stretch[1] + p2 * stretch[2]


@numba.njit(fastmath=ORDERED, **KERNEL)
def _gradients_adjoint(output, limit, conserve, grad_gradient, grad_rotation, grad):
    qu, qv, stretch = np.empty(4, np.float32), np.empty(4, np.float32), np.empty(3, np.float32)
    u, v = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
    gu, gv, gs = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32), np.empty(3, np.float32)
    for i in range(output.shape[0]):
        nu, nv = _rotation(output, i, 0, qu, u), _rotation(output, i, 4, qv, v)
        _stretches(output, i, limit, conserve, stretch)
        f, r = grad_gradient[i], grad_rotation[i]
        for k in range(3):
            total = np.float32(0)
            for a in range(3):
                fv = f[a, 0] * v[0, k] + f[a, 1] * v[1, k] + f[a, 2] * v[2, k]
                fu = f[0, a] * u[0, k] + f[1, a] * u[1, k] + f[2, a] * u[2, k]
                rv = r[a, 0] * v[0, k] + r[a, 1] * v[1, k] + r[a, 2] * v[2, k]
                ru = r[0, a] * u[0, k] + r[1, a] * u[1, k] + r[2, a] * u[2, k]
                gu[a, k] = fv * stretch[k] + rv
                gv[a, k] = fu * stretch[k] + ru
                total += u[a, k] * fv
            gs[k] = total * stretch[k]
        mean = THIRD * (gs[0] + gs[1] + gs[2]) if conserve else np.float32(0)
        for k in range(3):
            inside = -limit <= output[i, 8 + k] <= limit
            grad[i, 8 + k] = gs[k] - mean if inside else np.float32(0)
        _rotation_adjoint(qu, nu, gu, grad, i, 0)
        _rotation_adjoint(qv, nv, gv, grad, i, 4)


class _GradientFromOutput(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, output: Tensor, conserve_mass: bool) -> tuple[Tensor, Tensor]:
        gradient = np.empty((len(output), 3, 3), np.float32)
        rotation = np.empty((len(output), 3, 3), np.float32)
        _gradients(array(output), LIMIT, conserve_mass, gradient, rotation)
        ctx.save_for_backward(output)
        ctx.conserve_mass = conserve_mass
        return torch.from_numpy(gradient), torch.from_numpy(rotation)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_gradient: Tensor, grad_rotation: Tensor) -> Any:
        (output,) = ctx.saved_tensors
        grad = np.empty(output.shape, np.float32)
        _gradients_adjoint(
            array(output), LIMIT, ctx.conserve_mass, array(grad_gradient), array(grad_rotation), grad
        )  # fmt: skip
        return torch.from_numpy(grad), None


def gradient_from_output(output: Tensor, *, conserve_mass: bool) -> tuple[Tensor, Tensor]:
    """:func:`gausim.ops.deformation.gradient_from_output`."""
    found: tuple[Tensor, Tensor] = _GradientFromOutput.apply(output, conserve_mass)
    return found


@numba.njit(fastmath=ORDERED, **KERNEL)
def polar_rotations(matrices, iterations, rotations):
    """Newton's iteration R <- (R + R^-T) / 2 for every matrix, written to ``rotations``."""
    for i in range(matrices.shape[0]):
        m = matrices[i]
        a, b, c = m[0, 0], m[0, 1], m[0, 2]
        d, e, f = m[1, 0], m[1, 1], m[1, 2]
        g, h, k = m[2, 0], m[2, 1], m[2, 2]
        for _ in range(iterations):
            a1, b1, c1 = e * k - f * h, f * g - d * k, d * h - e * g
            d1, e1, f1 = h * c - k * b, k * a - g * c, g * b - h * a
            g1, h1, k1 = b * f - c * e, c * d - a * f, a * e - b * d
            scale = HALF / (a * a1 + b * b1 + c * c1)
            a, b, c = HALF * a + scale * a1, HALF * b + scale * b1, HALF * c + scale * c1
            d, e, f = HALF * d + scale * d1, HALF * e + scale * e1, HALF * f + scale * f1
            g, h, k = HALF * g + scale * g1, HALF * h + scale * h1, HALF * k + scale * k1
        r = rotations[i]
        r[0, 0], r[0, 1], r[0, 2] = a, b, c
        r[1, 0], r[1, 1], r[1, 2] = d, e, f
        r[2, 0], r[2, 1], r[2, 2] = g, h, k


def polar_rotation(gradient: Tensor) -> Tensor:
    """:func:`gausim.ops.deformation.polar_rotation`."""
    found = np.empty((gradient.numel() // 9, 3, 3), np.float32)
    polar_rotations(array(gradient).reshape(-1, 3, 3), POLAR_ITERATIONS, found)
    return torch.from_numpy(found).view(gradient.shape)


@numba.njit(fastmath=ORDERED, **KERNEL)
def _bound(matrices, least, unit, bounded, factors):
    """Matrices, scaled by their ``factors``; a factor of 0 stands for the identity in place of the matrix."""
    for i in range(matrices.shape[0]):
        m = matrices[i]
        det = (
            m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
            + m[0, 1] * (m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2])
            + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
        )
        factors[i] = np.float32(0) if det < least else (np.float32(det ** (-1 / 3)) if unit else ONE)
        for a in range(3):
            for b in range(3):
                if det < least:
                    bounded[i, a, b] = ONE if a == b else np.float32(0)
                else:
                    bounded[i, a, b] = factors[i] * m[a, b]


@numba.njit(fastmath=ORDERED, **KERNEL)
def _bound_adjoint(bounded, factors, unit, g, grad):
    """From d det = det tr(M^-1 dM), so that of B = det^(-1/3) M, itself of determinant 1, dB has -(1/3) tr(..) B."""
    for i in range(bounded.shape[0]):
        b, f = bounded[i], factors[i]
        along = np.float32(0)
        if unit and f != 0:
            for r in range(3):
                along += b[r, 0] * g[i, r, 0] + b[r, 1] * g[i, r, 1] + b[r, 2] * g[i, r, 2]
            along *= THIRD
        for r in range(3):
            p, q = (r + 1) % 3, (r + 2) % 3
            for c in range(3):
                s, t = (c + 1) % 3, (c + 2) % 3
                cofactor = b[p, s] * b[q, t] - b[p, t] * b[q, s]
                grad[i, r, c] = f * (g[i, r, c] - along * cofactor)


class _BoundedDeformation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gradient: Tensor, least: float, unit: bool) -> Tensor:
        bounded, factors = np.empty(gradient.shape, np.float32), np.empty(len(gradient), np.float32)
        _bound(array(gradient), np.float32(least), unit, bounded, factors)
        result = torch.from_numpy(bounded)
        ctx.save_for_backward(result, torch.from_numpy(factors))
        ctx.unit = unit
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        bounded, factors = (array(t) for t in ctx.saved_tensors)
        found = np.empty(bounded.shape, np.float32)
        _bound_adjoint(bounded, factors, ctx.unit, array(grad), found)
        return torch.from_numpy(found), None, None


def bounded_deformation(gradient: Tensor, least: float, *, unit: bool) -> Tensor:
    """:func:`gausim.ops.deformation.bounded_deformation`."""
    found: Tensor = _BoundedDeformation.apply(gradient, least, unit)
    return found
