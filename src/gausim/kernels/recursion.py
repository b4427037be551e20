"""Compiled forms of :mod:`gausim.models.step.recursion`, with their gradients."""

# The kernels carry no annotations: numba has to compile them as they are.
# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from gausim.kernels.compiled import array
from gausim.kernels.deformation import POLAR_ITERATIONS, polar_rotations
from gausim.kernels.jit import HELPER, KERNEL, ORDERED


@numba.njit(fastmath=ORDERED, **HELPER)
def _product(a, b, out):
    """A B of 3x3 matrices."""
    for i in range(3):
        for k in range(3):
            out[i, k] = a[i, 0] * b[0, k] + a[i, 1] * b[1, k] + a[i, 2] * b[2, k]


@numba.njit(fastmath=ORDERED, **HELPER)
def _add_product_adjoint(a, b, g, g_a, g_b):
    """Adds G B^T and A^T G, the gradients of A and B where G is that of A B."""
    for i in range(3):
        for k in range(3):
            g_a[i, k] += g[i, 0] * b[k, 0] + g[i, 1] * b[k, 1] + g[i, 2] * b[k, 2]
            g_b[i, k] += a[0, i] * g[0, k] + a[1, i] * g[1, k] + a[2, i] * g[2, k]


@numba.njit(fastmath=ORDERED, **KERNEL)
def _advance(own, turn, target, centre, template, gradient, rotation, index, accumulated, turned, after):
    for i in range(index.shape[0]):
        p, a = index[i], accumulated[i]
        c, t = centre[p], template[p]
        _product(own[i], gradient[p], a)
        _product(turn[i], rotation[p], turned[i])
        x, y, z = target[i, 0] - t[0], target[i, 1] - t[1], target[i, 2] - t[2]
        for k in range(3):
            after[i, k] = c[k] + (a[k, 0] * x + a[k, 1] * y + a[k, 2] * z)


@numba.njit(fastmath=ORDERED, **KERNEL)
def _advance_adjoint(own, turn, target, template, gradient, rotation, index, accumulated, grads, found):
    g_accumulated, g_turned, g_after = grads
    g_own, g_turn, g_target, g_centre, g_template, g_gradient, g_rotation = found
    whole = np.empty((3, 3), np.float32)
    for i in range(index.shape[0]):
        p, a, g = index[i], accumulated[i], g_after[i]
        for k in range(3):
            offset = target[i, k] - template[p, k]
            whole[0, k] = g_accumulated[i, 0, k] + g[0] * offset
            whole[1, k] = g_accumulated[i, 1, k] + g[1] * offset
            whole[2, k] = g_accumulated[i, 2, k] + g[2] * offset
            pulled = a[0, k] * g[0] + a[1, k] * g[1] + a[2, k] * g[2]
            g_target[i, k] = pulled
            g_template[p, k] -= pulled
            g_centre[p, k] += g[k]
        _add_product_adjoint(own[i], gradient[p], whole, g_own[i], g_gradient[p])
        _add_product_adjoint(turn[i], rotation[p], g_turned[i], g_turn[i], g_rotation[p])


class Advance(torch.autograd.Function):
    """:func:`gausim.models.step.recursion.advance`."""

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Takes own gradient, rotation and target, the parents' four tensors and the parent of each unit."""
        count = len(inputs[0])
        accumulated, turned = np.empty((count, 3, 3), np.float32), np.empty((count, 3, 3), np.float32)
        after = np.empty((count, 3), np.float32)
        _advance(*(array(t) for t in inputs), accumulated, turned, after)
        result = torch.from_numpy(accumulated), torch.from_numpy(turned), torch.from_numpy(after)
        ctx.save_for_backward(*inputs[:3], *inputs[4:], result[0])
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Any:
        """Gradients of the first seven."""
        arrays = tuple(array(t) for t in ctx.saved_tensors)
        own, turn, target, template, gradient, rotation, *_ = arrays
        shapes = own, turn, target, template, template, gradient, rotation
        found = tuple(np.zeros(a.shape, np.float32) for a in shapes)
        _advance_adjoint(*arrays, tuple(array(g) for g in grads), found)
        return (*(torch.from_numpy(f) for f in found), None)


@numba.njit(fastmath=ORDERED, **KERNEL)
def _carry(points, centre, after, gradient, index, carried):
    for k in range(points.shape[0]):
        c = index[k]
        if c < 0:
            carried[k, 0], carried[k, 1], carried[k, 2] = points[k, 0], points[k, 1], points[k, 2]
            continue
        g = gradient[c]
        x, y, z = points[k, 0] - centre[c, 0], points[k, 1] - centre[c, 1], points[k, 2] - centre[c, 2]
        carried[k, 0] = after[c, 0] + (g[0, 0] * x + g[0, 1] * y + g[0, 2] * z)
        carried[k, 1] = after[c, 1] + (g[1, 0] * x + g[1, 1] * y + g[1, 2] * z)
        carried[k, 2] = after[c, 2] + (g[2, 0] * x + g[2, 1] * y + g[2, 2] * z)


@numba.njit(fastmath=ORDERED, **KERNEL)
def _carry_adjoint(points, centre, gradient, index, grad, g_centre, g_after, g_gradient):
    for k in range(points.shape[0]):
        c = index[k]
        if c < 0:
            continue
        g0, g1, g2 = grad[k, 0], grad[k, 1], grad[k, 2]
        g_after[c, 0] += g0
        g_after[c, 1] += g1
        g_after[c, 2] += g2
        for i in range(3):
            offset = points[k, i] - centre[c, i]
            g_gradient[c, 0, i] += g0 * offset
            g_gradient[c, 1, i] += g1 * offset
            g_gradient[c, 2, i] += g2 * offset
    for c in range(gradient.shape[0]):
        g, a = gradient[c], g_after[c]
        for i in range(3):
            g_centre[c, i] = -(g[0, i] * a[0] + g[1, i] * a[1] + g[2, i] * a[2])


@numba.njit(fastmath=ORDERED, **KERNEL)
def _deform_template(accumulated, turned, template, polar, rows, total, rotation):
    """Gradients and rotations of the units after the template's, written to their ``rows``; identities elsewhere."""
    for n in range(total.shape[0]):
        for i in range(3):
            for k in range(3):
                total[n, i, k] = rotation[n, i, k] = np.float32(1) if i == k else np.float32(0)
    for c in range(accumulated.shape[0]):
        if template.shape[0]:
            _product(accumulated[c], template[c], total[rows[c]])
            _product(turned[c], polar[c], rotation[rows[c]])
        else:
            total[rows[c]], rotation[rows[c]] = accumulated[c], turned[c]


@numba.njit(fastmath=ORDERED, **KERNEL)
def _deform_template_adjoint(accumulated, template, polar, rows, g_total, g_rotation, found):
    """``g_total`` is the gradient of each unit's total gradient, ``g_rotation`` that of the padded rotations."""
    g_accumulated, g_turned, g_template = found
    for c in range(accumulated.shape[0]):
        g = g_rotation[rows[c]]
        if template.shape[0]:
            _add_product_adjoint(accumulated[c], template[c], g_total[c], g_accumulated[c], g_template[c])
            for i in range(3):
                for k in range(3):
                    g_turned[c, i, k] = g[i, 0] * polar[c, k, 0] + g[i, 1] * polar[c, k, 1] + g[i, 2] * polar[c, k, 2]
        else:
            g_accumulated[c], g_turned[c] = g_total[c], g


class Inherit(torch.autograd.Function):
    """:func:`gausim.models.step.recursion.inherit`."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Takes the units' accumulated and template gradient, rotation, centre, new place, then constants."""
        accumulated, template, turned, centre, after, points, index, rows, padded = inputs
        moves = template is not None
        polar = np.empty((len(accumulated) if moves else 0, 3, 3), np.float32)
        shape = array(template) if moves else polar
        if moves:
            polar_rotations(shape, POLAR_ITERATIONS, polar)
        total, rotation = np.empty((padded, 3, 3), np.float32), np.empty((padded, 3, 3), np.float32)
        _deform_template(array(accumulated), array(turned), shape, polar, array(rows), total, rotation)
        positions, inner = np.empty(points.shape, np.float32), total[array(rows)]
        _carry(array(points), array(centre), array(after), inner, array(index), positions)
        kept = [accumulated, centre, points, index, rows, torch.from_numpy(polar), torch.from_numpy(inner)]
        ctx.save_for_backward(*kept, *([template] if moves else []))
        return torch.from_numpy(positions), torch.from_numpy(total), torch.from_numpy(rotation)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor, grad_total: Tensor, grad_rotation: Tensor) -> Any:
        """Gradients of the first five; the rotation of the template is a constant."""
        accumulated, centre, points, index, rows, polar, inner, *template = (array(t) for t in ctx.saved_tensors)
        g_inner = array(grad_total)[rows]
        g_centre, g_after = np.empty(centre.shape, np.float32), np.zeros(centre.shape, np.float32)
        _carry_adjoint(points, centre, inner, index, array(grad), g_centre, g_after, g_inner)
        shape = template[0] if template else polar
        found = tuple(np.zeros(a.shape, np.float32) for a in (accumulated, accumulated, shape))
        _deform_template_adjoint(accumulated, shape, polar, rows, g_inner, array(grad_rotation), found)
        g_accumulated, g_turned, g_template = (torch.from_numpy(f) for f in found)
        moves = g_template if template else None
        return g_accumulated, moves, g_turned, torch.from_numpy(g_centre), torch.from_numpy(g_after), *[None] * 4
