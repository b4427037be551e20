"""Fast forms of the forces of finite strain and of springs, one unit or spring after the other, and their adjoints."""

# Annotations would be checked by beartype in the tests, around functions that numba has to compile.
# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from gausim.kernels.jit import FINITE_MATH_OFF, KERNEL
from gausim.kernels.operations import LEAST_SQUARE, array

ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
LEAST = np.float32(LEAST_SQUARE)


@numba.njit(fastmath=FINITE_MATH_OFF, **KERNEL)
def strain_forces(first, second, moduli, damping, slope, out, by_first, by_moduli):
    """Stress on deformation beyond that of small strains of every unit (S, N, 3, 3), or its adjoint.

    With a ``slope``, the loss gradient of the result, ``out`` is that of ``second``, ``by_first`` and ``by_moduli`` are
    those of ``first`` and of both ``moduli`` (2 mu, lambda) times volume, and that of ``damping`` is returned.
    """
    room = np.empty((6, 3, 3), np.float32)
    mean, strain, stress, grown, pull, pressed = room[0], room[1], room[2], room[3], room[4], room[5]
    early, late, by_damping = HALF - damping, HALF + damping, 0.0
    for s in range(first.shape[0]):
        for n in range(first.shape[1]):
            f, g, shear, bulk = first[s, n], second[s, n], moduli[n, 0], moduli[n, 1]
            for i in range(3):
                for j in range(3):
                    a, b = f[i, j] + f[j, i], g[i, j] + g[j, i]
                    for k in range(3):
                        a += f[k, i] * f[k, j]
                        b += g[k, i] * g[k, j]
                    strain[i, j], grown[i, j] = HALF * (early * a + late * b), HALF * (b - a)
                    mean[i, j] = HALF * (f[i, j] + g[i, j])
            growth, trace = strain[0, 0] + strain[1, 1] + strain[2, 2], mean[0, 0] + mean[1, 1] + mean[2, 2]
            for i in range(3):
                for j in range(3):
                    stress[i, j] = shear * strain[i, j]
                stress[i, i] += bulk * growth
            if slope.size == 0:
                for i in range(3):
                    for j in range(3):
                        total = stress[i, j] - shear * HALF * (mean[i, j] + mean[j, i])
                        for k in range(3):
                            total += mean[i, k] * stress[k, j]
                        out[s, n, i, j] = total
                    out[s, n, i, i] -= bulk * trace
                continue
            w = slope[s, n]
            for i in range(3):
                for j in range(3):
                    total = w[i, j] + w[j, i]
                    for k in range(3):
                        total += mean[k, i] * w[k, j] + mean[k, j] * w[k, i]
                    pressed[i, j] = HALF * total
            pressure, along = pressed[0, 0] + pressed[1, 1] + pressed[2, 2], w[0, 0] + w[1, 1] + w[2, 2]
            by_shear = ZERO
            for i in range(3):
                for j in range(3):
                    by_shear += pressed[i, j] * strain[i, j] - HALF * (w[i, j] + w[j, i]) * mean[i, j]
                    pull[i, j] = -shear * HALF * (w[i, j] + w[j, i])
                    for k in range(3):
                        pull[i, j] += w[i, k] * stress[k, j]
                pull[i, i] -= bulk * along
            by_moduli[n, 0] += by_shear
            by_moduli[n, 1] += pressure * growth - along * trace
            for i in range(3):
                for j in range(3):
                    pressed[i, j] *= shear
                pressed[i, i] += bulk * pressure
            for i in range(3):
                for j in range(3):
                    by_damping += pressed[i, j] * grown[i, j]
                    a, b = pressed[i, j], pressed[i, j]
                    for k in range(3):
                        a += f[i, k] * pressed[k, j]
                        b += g[i, k] * pressed[k, j]
                    by_first[s, n, i, j] = HALF * pull[i, j] + early * a
                    out[s, n, i, j] = HALF * pull[i, j] + late * b
    return by_damping


@numba.njit(fastmath=FINITE_MATH_OFF, **KERNEL)
def spring_forces(first, second, offset, length, stiffness, damping, slope, out, by_first, by_stiffness):
    """Pull beyond the linear one of every spring (S, E, 3), or its adjoint; as :func:`strain_forces`."""
    early, late, by_damping = HALF - damping, HALF + damping, 0.0
    for s in range(first.shape[0]):
        for e in range(first.shape[1]):
            f, g, o = first[s, e], second[s, e], offset[e]
            squared = length[e] * length[e]
            along_f, along_g = o[0] * f[0] + o[1] * f[1] + o[2] * f[2], o[0] * g[0] + o[1] * g[1] + o[2] * g[2]
            grown_f = TWO * along_f + f[0] * f[0] + f[1] * f[1] + f[2] * f[2]
            grown_g = TWO * along_g + g[0] * g[0] + g[1] * g[1] + g[2] * g[2]
            length_f = np.sqrt(max(squared + grown_f, LEAST * squared))
            length_g = np.sqrt(max(squared + grown_g, LEAST * squared))
            stretch_f, stretch_g = grown_f / (length_f + length[e]), grown_g / (length_g + length[e])
            both = ONE / (length_f + length_g)
            shrink = TWO * (early * stretch_f + late * stretch_g) * both
            linear = HALF * (along_f + along_g) / squared
            k = stiffness[e]
            if slope.size == 0:
                for i in range(3):
                    out[s, e, i] = k * (shrink * HALF * (f[i] + g[i]) + (shrink - linear) * o[i])
                continue
            w = slope[s, e]
            across, turned = ZERO, ZERO
            for i in range(3):
                across += w[i] * (o[i] + HALF * (f[i] + g[i]))
                turned += w[i] * o[i]
            by_stiffness[e] += shrink * across - linear * turned
            by_damping += k * across * TWO * (stretch_g - stretch_f) * both
            # Derivatives of length and stretch along d; equal but for springs that are held at their least length.
            longer_f, more_f = ONE / length_f, ONE / length_f
            if squared + grown_f < LEAST * squared:
                longer_f, more_f = ZERO, TWO / (length_f + length[e])
            longer_g, more_g = ONE / length_g, ONE / length_g
            if squared + grown_g < LEAST * squared:
                longer_g, more_g = ZERO, TWO / (length_g + length[e])
            on_f = across * both * (TWO * early * more_f - shrink * longer_f)
            on_g = across * both * (TWO * late * more_g - shrink * longer_g)
            flat = HALF * turned / squared
            for i in range(3):
                by_first[s, e, i] = k * (HALF * shrink * w[i] + on_f * (o[i] + f[i]) - flat * o[i])
                out[s, e, i] = k * (HALF * shrink * w[i] + on_g * (o[i] + g[i]) - flat * o[i])
    return by_damping


class _Forces(torch.autograd.Function):
    """One of the kernels of some constants as a node of the graph, with its adjoint."""

    @staticmethod
    def forward(
        ctx: Any, kernel: Any, constants: Any, first: Tensor, second: Tensor, stiffness: Tensor, damping: Any
    ) -> Tensor:
        inputs = array(first), array(second), *constants, array(stiffness), np.float32(damping)
        out = np.empty_like(inputs[0])
        none = np.empty((0,) * out.ndim, np.float32)
        kernel(*inputs, none, out, none, np.zeros_like(inputs[-2][:0]))
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(first, second, stiffness)
            ctx.kernel, ctx.inputs = kernel, inputs
        return torch.from_numpy(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, slope: Tensor) -> Any:
        _ = ctx.saved_tensors  # raises if an input was changed in place since then
        first, stiffness = ctx.inputs[0], ctx.inputs[-2]
        by_first, by_second, by_stiffness = np.empty_like(first), np.empty_like(first), np.zeros_like(stiffness)
        by_damping = ctx.kernel(*ctx.inputs, array(slope), by_second, by_first, by_stiffness)
        found = (*map(torch.from_numpy, (by_first, by_second, by_stiffness)), torch.tensor(by_damping).float())
        needed = ctx.needs_input_grad[2:]
        return None, None, *(x if need else None for x, need in zip(found, needed, strict=True))


def strain_pull(first: Tensor, second: Tensor, moduli: Tensor, damping: Tensor | float) -> Tensor:
    """:func:`gausim.models.template.finite_strain.strain_pull`."""
    found: Tensor = _Forces.apply(strain_forces, (), first, second, moduli, damping)
    return found


def spring_pull(
    first: Tensor, second: Tensor, offset: Tensor, length: Tensor, stiffness: Tensor, damping: Tensor | float
) -> Tensor:
    """:func:`gausim.models.template.springs.spring_pull`."""
    found: Tensor = _Forces.apply(spring_forces, (array(offset), array(length)), first, second, stiffness, damping)
    return found
