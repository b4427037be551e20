"""Compiled form of :func:`gausim.models.step.features.network_inputs`, with its gradients."""

# The kernels carry no annotations: numba has to compile them as they are.
# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from gausim.kernels.compiled import array
from gausim.kernels.jit import HELPER, KERNEL, ORDERED

ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
TINY2, TINY4 = np.float32(1e-12), np.float32(1e-24)  # squares of gausim.models.step.features.TINY

# Columns of the scratch arrays of a unit and of its parent [diagonals].
REST, NOW, BEFORE, AFTER = 0, 3, 6, 9


@numba.njit(fastmath=ORDERED, **KERNEL)
def _gather(unit, parents, index, size, own, above):
    """Own and parent's positions in diagonals; AFTER is the coarse prediction and the parent's new place."""
    rest, now, before, target = unit
    p_rest, p_now, p_before, p_after, p_template, p_gradient = parents
    for i in range(rest.shape[0]):
        p, inverse = index[i], ONE / size[i]
        t0, t1, t2 = target[i, 0] - p_template[p, 0], target[i, 1] - p_template[p, 1], target[i, 2] - p_template[p, 2]
        for k in range(3):
            g = p_gradient[p, k]
            value = p_after[p, k] + (g[0] * t0 + g[1] * t1 + g[2] * t2)
            own[i, REST + k], own[i, NOW + k] = rest[i, k] * inverse, now[i, k] * inverse
            own[i, BEFORE + k], own[i, AFTER + k] = before[i, k] * inverse, value * inverse
            above[i, REST + k], above[i, NOW + k] = p_rest[p, k] * inverse, p_now[p, k] * inverse
            above[i, BEFORE + k], above[i, AFTER + k] = p_before[p, k] * inverse, p_after[p, k] * inverse


@numba.njit(fastmath=ORDERED, **KERNEL)
def _gather_adjoint(target, p_template, p_gradient, index, size, g_own, g_above, g_unit, g_parents):
    """Gradients of the unit's and the parents' positions; those of the parents add up over their children."""
    g_rest, g_now, g_before, g_target = g_unit
    gp_rest, gp_now, gp_before, gp_after, gp_template, gp_gradient = g_parents
    for i in range(target.shape[0]):
        p, inverse = index[i], ONE / size[i]
        c0, c1, c2 = g_own[i, AFTER] * inverse, g_own[i, AFTER + 1] * inverse, g_own[i, AFTER + 2] * inverse
        gp_after[p, 0] += c0
        gp_after[p, 1] += c1
        gp_after[p, 2] += c2
        g = p_gradient[p]
        for k in range(3):
            offset = target[i, k] - p_template[p, k]
            gp_gradient[p, 0, k] += c0 * offset
            gp_gradient[p, 1, k] += c1 * offset
            gp_gradient[p, 2, k] += c2 * offset
            carried = g[0, k] * c0 + g[1, k] * c1 + g[2, k] * c2
            g_target[i, k] = carried
            gp_template[p, k] -= carried
            g_rest[i, k], g_now[i, k] = g_own[i, REST + k] * inverse, g_own[i, NOW + k] * inverse
            g_before[i, k] = g_own[i, BEFORE + k] * inverse
            gp_rest[p, k] += g_above[i, REST + k] * inverse
            gp_now[p, k] += g_above[i, NOW + k] * inverse
            gp_before[p, k] += g_above[i, BEFORE + k] * inverse
            gp_after[p, k] += g_above[i, AFTER + k] * inverse


@numba.njit(fastmath=ORDERED, **KERNEL)
def _nodes(own, above, size, dt, gravity, density, attributes, rest_inputs, from_coarse, nodes):
    x = AFTER if from_coarse else NOW
    for i in range(own.shape[0]):
        u, c, rate, column = own[i], above[i], ONE / dt[i], 6
        for k in range(3):
            bend = u[BEFORE + k] - c[BEFORE + k]
            nodes[i, k] = gravity[k] / size[i] - (c[AFTER + k] - TWO * c[NOW + k] + c[BEFORE + k]) * (rate * rate)
            nodes[i, 3 + k] = ((u[x + k] - c[x + k]) - bend) * rate
            if rest_inputs:
                nodes[i, 6 + k] = u[NOW + k] - u[REST + k]
                nodes[i, 9 + k] = (u[AFTER + k] - u[NOW + k]) * rate
        if rest_inputs:
            column = 12
        nodes[i, column] = density[i]
        for k in range(attributes.shape[1]):
            nodes[i, column + 1 + k] = attributes[i, k]


@numba.njit(fastmath=ORDERED, **KERNEL)
def _nodes_adjoint(g_nodes, dt, rest_inputs, from_coarse, g_own, g_above, g_density, g_attributes):
    x = AFTER if from_coarse else NOW
    for i in range(g_nodes.shape[0]):
        g, u, c, rate, column = g_nodes[i], g_own[i], g_above[i], ONE / dt[i], 6
        for k in range(3):
            inertial, velocity = g[k] * (rate * rate), g[3 + k] * rate
            c[AFTER + k] -= inertial
            c[NOW + k] += TWO * inertial
            c[BEFORE + k] += velocity - inertial
            u[x + k] += velocity
            c[x + k] -= velocity
            u[BEFORE + k] -= velocity
            if rest_inputs:
                step = g[9 + k] * rate
                u[NOW + k] += g[6 + k] - step
                u[REST + k] -= g[6 + k]
                u[AFTER + k] += step
        if rest_inputs:
            column = 12
        g_density[i] = g[column]
        for k in range(g_attributes.shape[1]):
            g_attributes[i, k] = g[column + 1 + k]


@numba.njit(fastmath=ORDERED, **HELPER)
def _angle(a0, a1, a2, b0, b1, b2):
    """Cosine and sine of the angle between a and b, both 0 where one of them vanishes; and what they are made of."""
    dot = a0 * b0 + a1 * b1 + a2 * b2
    k0, k1, k2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    across = math.sqrt(k0 * k0 + k1 * k1 + k2 * k2 + TINY4)
    aa, bb = a0 * a0 + a1 * a1 + a2 * a2 + TINY2, b0 * b0 + b1 * b1 + b2 * b2 + TINY2
    inverse = ONE / math.sqrt(aa * bb)
    return dot * inverse, across * inverse, inverse, across, aa, bb, k0, k1, k2


@numba.njit(fastmath=ORDERED, **KERNEL)
def _edges(own, above, source, destination, dt, rest_inputs, from_coarse, cos_sin, edges):
    x = AFTER if from_coarse else NOW
    for e in range(source.shape[0]):
        i, j = destination[e], source[e]
        d, s, c, out = own[i], own[j], above[i], edges[e]
        n0, n1, n2 = d[x] - s[x], d[x + 1] - s[x + 1], d[x + 2] - s[x + 2]
        r0, r1, r2 = d[REST] - s[REST], d[REST + 1] - s[REST + 1], d[REST + 2] - s[REST + 2]
        rate, now = ONE / dt[i], n0 * n0 + n1 * n1 + n2 * n2 + TINY2
        inverse = ONE / math.sqrt(now)
        out[0] = math.sqrt(now / (r0 * r0 + r1 * r1 + r2 * r2 + TINY2))
        out[1], out[2], out[3] = n0 * inverse, n1 * inverse, n2 * inverse
        out[4] = (n0 - (d[BEFORE] - s[BEFORE])) * rate
        out[5] = (n1 - (d[BEFORE + 1] - s[BEFORE + 1])) * rate
        out[6] = (n2 - (d[BEFORE + 2] - s[BEFORE + 2])) * rate
        column = 7
        if rest_inputs:
            out[7], out[8], out[9] = r0, r1, r2
            out[10], out[11], out[12] = n0 - r0, n1 - r1, n2 - r2
            column = 13
        a0, a1, a2 = d[x] - c[x], d[x + 1] - c[x + 1], d[x + 2] - c[x + 2]
        b0, b1, b2 = s[x] - c[x], s[x + 1] - c[x + 1], s[x + 2] - c[x + 2]
        p0, p1, p2 = d[REST] - c[REST], d[REST + 1] - c[REST + 1], d[REST + 2] - c[REST + 2]
        q0, q1, q2 = s[REST] - c[REST], s[REST + 1] - c[REST + 1], s[REST + 2] - c[REST + 2]
        if cos_sin:
            cos, sin = _angle(a0, a1, a2, b0, b1, b2)[:2]
            rest_cos, rest_sin = _angle(p0, p1, p2, q0, q1, q2)[:2]
            out[column] = cos * rest_cos + sin * rest_sin
            out[column + 1] = sin * rest_cos - cos * rest_sin
        else:
            out[column] = (a0 * b0 + a1 * b1 + a2 * b2) - (p0 * q0 + p1 * q1 + p2 * q2)


@numba.njit(fastmath=ORDERED, **HELPER)
def _angle_adjoint(a0, a1, a2, b0, b1, b2, parts, g_cos, g_sin, gd, gs, gc, x):
    """Adds the gradient of cosine and sine of the angle between a = d - c and b = s - c."""
    cos, sin, inverse, across, aa, bb, k0, k1, k2 = parts
    dot, length = g_cos * inverse, g_cos * cos + g_sin * sin
    cross, la, lb = g_sin * inverse / across, length / aa, length / bb
    k0, k1, k2 = k0 * cross, k1 * cross, k2 * cross
    u0 = dot * b0 - la * a0 + (b1 * k2 - b2 * k1)
    u1 = dot * b1 - la * a1 + (b2 * k0 - b0 * k2)
    u2 = dot * b2 - la * a2 + (b0 * k1 - b1 * k0)
    v0 = dot * a0 - lb * b0 + (k1 * a2 - k2 * a1)
    v1 = dot * a1 - lb * b1 + (k2 * a0 - k0 * a2)
    v2 = dot * a2 - lb * b2 + (k0 * a1 - k1 * a0)
    gd[x] += u0
    gd[x + 1] += u1
    gd[x + 2] += u2
    gs[x] += v0
    gs[x + 1] += v1
    gs[x + 2] += v2
    gc[x] -= u0 + v0
    gc[x + 1] -= u1 + v1
    gc[x + 2] -= u2 + v2


@numba.njit(fastmath=ORDERED, **KERNEL)
def _edges_adjoint(own, above, source, destination, dt, rest_inputs, from_coarse, cos_sin, g_edges, g_own, g_above):
    x = AFTER if from_coarse else NOW
    g_now, g_rest = np.empty(3, np.float32), np.empty(3, np.float32)
    for e in range(source.shape[0]):
        i, j = destination[e], source[e]
        d, s, c, g = own[i], own[j], above[i], g_edges[e]
        gd, gs, gc = g_own[i], g_own[j], g_above[i]
        n0, n1, n2 = d[x] - s[x], d[x + 1] - s[x + 1], d[x + 2] - s[x + 2]
        r0, r1, r2 = d[REST] - s[REST], d[REST + 1] - s[REST + 1], d[REST + 2] - s[REST + 2]
        now, rest = n0 * n0 + n1 * n1 + n2 * n2 + TINY2, r0 * r0 + r1 * r1 + r2 * r2 + TINY2
        inverse, rate = ONE / math.sqrt(now), ONE / dt[i]
        ratio = math.sqrt(now / rest) * g[0]
        along = (n0 * g[1] + n1 * g[2] + n2 * g[3]) * inverse
        stretch, shrink = (ratio - along) / now, -ratio / rest
        g_now[0] = n0 * stretch + g[1] * inverse + g[4] * rate
        g_now[1] = n1 * stretch + g[2] * inverse + g[5] * rate
        g_now[2] = n2 * stretch + g[3] * inverse + g[6] * rate
        g_rest[0], g_rest[1], g_rest[2] = r0 * shrink, r1 * shrink, r2 * shrink
        column = 7
        if rest_inputs:
            column = 13
            for k in range(3):
                g_now[k] += g[10 + k]
                g_rest[k] += g[7 + k] - g[10 + k]
        for k in range(3):
            gd[x + k] += g_now[k]
            gs[x + k] -= g_now[k]
            gd[REST + k] += g_rest[k]
            gs[REST + k] -= g_rest[k]
            gd[BEFORE + k] -= g[4 + k] * rate
            gs[BEFORE + k] += g[4 + k] * rate
        a0, a1, a2 = d[x] - c[x], d[x + 1] - c[x + 1], d[x + 2] - c[x + 2]
        b0, b1, b2 = s[x] - c[x], s[x + 1] - c[x + 1], s[x + 2] - c[x + 2]
        p0, p1, p2 = d[REST] - c[REST], d[REST + 1] - c[REST + 1], d[REST + 2] - c[REST + 2]
        q0, q1, q2 = s[REST] - c[REST], s[REST + 1] - c[REST + 1], s[REST + 2] - c[REST + 2]
        if cos_sin:
            turned, still = _angle(a0, a1, a2, b0, b1, b2), _angle(p0, p1, p2, q0, q1, q2)
            g_cos = g[column] * still[0] - g[column + 1] * still[1]
            g_sin = g[column] * still[1] + g[column + 1] * still[0]
            _angle_adjoint(a0, a1, a2, b0, b1, b2, turned, g_cos, g_sin, gd, gs, gc, x)
            g_cos = g[column] * turned[0] + g[column + 1] * turned[1]
            g_sin = g[column] * turned[1] - g[column + 1] * turned[0]
            _angle_adjoint(p0, p1, p2, q0, q1, q2, still, g_cos, g_sin, gd, gs, gc, REST)
        else:
            _inner_adjoint(a0, a1, a2, b0, b1, b2, g[column], gd, gs, gc, x)
            _inner_adjoint(p0, p1, p2, q0, q1, q2, -g[column], gd, gs, gc, REST)


@numba.njit(fastmath=ORDERED, **HELPER)
def _inner_adjoint(a0, a1, a2, b0, b1, b2, g, gd, gs, gc, x):
    """Adds the gradient of the product of a = d - c and b = s - c."""
    for k, a, b in ((0, a0, b0), (1, a1, b1), (2, a2, b2)):
        gd[x + k] += g * b
        gs[x + k] += g * a
        gc[x + k] -= g * (a + b)


class NetworkInputs(torch.autograd.Function):
    """Node and edge features of the units of one level."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:
        """Takes 4 positions, density and attributes of the units, 6 tensors of the parents, constants and choices."""
        positions, (density, attributes), above = inputs[0:4], inputs[4:6], inputs[6:12]
        index, edge_index, size, dt, gravity = (array(t) for t in inputs[12:17])
        rest_inputs, from_coarse, cos_sin = inputs[17]
        count = len(positions[0])
        own, parent = np.empty((count, 12), np.float32), np.empty((count, 12), np.float32)
        nodes = np.empty((count, (13 if rest_inputs else 7) + attributes.shape[1]), np.float32)
        edges = np.empty((edge_index.shape[1], (13 if rest_inputs else 7) + (2 if cos_sin else 1)), np.float32)
        unit, parents = tuple(array(t) for t in positions), tuple(array(t) for t in above)
        _gather(unit, parents, index, size, own, parent)
        _nodes(own, parent, size, dt, gravity, array(density), array(attributes), rest_inputs, from_coarse, nodes)
        _edges(own, parent, edge_index[0], edge_index[1], dt, rest_inputs, from_coarse, cos_sin, edges)
        kept = torch.from_numpy(own), torch.from_numpy(parent)
        ctx.save_for_backward(positions[3], above[4], above[5], *inputs[12:16], *kept)
        ctx.choices, ctx.width = inputs[17], attributes.shape[1]
        return torch.from_numpy(nodes), torch.from_numpy(edges)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_nodes: Tensor, grad_edges: Tensor) -> Any:
        """Gradients of the twelve tensors that have one."""
        target, template, gradient, index, edge_index, size, dt, own, parent = (array(t) for t in ctx.saved_tensors)
        (rest_inputs, from_coarse, cos_sin), width, parents = ctx.choices, ctx.width, len(template)
        g_own, g_parent = np.zeros_like(own), np.zeros_like(parent)
        g_density, g_attributes = np.empty(len(own), np.float32), np.empty((len(own), width), np.float32)
        _nodes_adjoint(array(grad_nodes), dt, rest_inputs, from_coarse, g_own, g_parent, g_density, g_attributes)
        _edges_adjoint(
            own, parent, edge_index[0], edge_index[1], dt, rest_inputs, from_coarse, cos_sin, array(grad_edges), g_own,
            g_parent,
        )  # fmt: skip
        g_unit = tuple(np.empty((len(own), 3), np.float32) for _ in range(4))
        g_parents = (*(np.zeros((parents, 3), np.float32) for _ in range(5)), np.zeros((parents, 3, 3), np.float32))
        _gather_adjoint(target, template, gradient, index, size, g_own, g_parent, g_unit, g_parents)
        grads = (*g_unit, g_density, g_attributes, *g_parents)
        return (*(torch.from_numpy(g) for g in grads), *[None] * 6)
