"""Fast form of :func:`gausim.render.draw.deformed_appearance`."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gausim.kernels.operations import array
from gausim.kernels.pool import shared_pool
from gausim.render.cpu.batch import ranges
from gausim.render.cpu.shading import shade, shade_adjoint
from gausim.render.draw import deformed_appearance as operation

# Tasks of one call: constants, so that loss gradients do not depend on the number of threads.
FORWARD_TASKS = 8
BACKWARD_TASKS = 4  # each has a separate array of the loss gradients of all units


def deformed_appearance(
    positions: Tensor,
    deformation_gradients: Tensor,
    rotations: Tensor,
    unit_of_kernel: Tensor,
    covars: Tensor,
    sh: Tensor,
    centers: Tensor,
) -> tuple[Tensor, Tensor]:
    """:func:`gausim.render.draw.deformed_appearance`, on torch's number of threads, which does not change a bit.

    The plain form computes loss gradients of the rest scene's covariances and coefficients.
    """
    if torch.is_grad_enabled() and (covars.requires_grad or sh.requires_grad):
        return operation.plain(positions, deformation_gradients, rotations, unit_of_kernel, covars, sh, centers)
    pool = shared_pool(torch.get_num_threads())
    found: tuple[Tensor, Tensor] = _Shade.apply(
        positions, deformation_gradients, rotations, unit_of_kernel, covars, sh, centers, pool
    )
    return found


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, deformation_gradients: Tensor, rotations: Tensor, *rest: Any) -> Any:
        unit, covars, sh, centers, pool = rest
        states, count = positions.shape[:2]
        inputs = [array(x) for x in (positions, deformation_gradients, rotations)]
        fixed = array(unit), array(covars), array(sh), round(sh.shape[1] ** 0.5) - 1, array(centers)
        out_covars = np.empty((states, count, 3, 3), np.float32)
        out_colors = np.empty((states, centers.shape[0], count, 3), np.float32)
        cuts = ranges(count, max(1, -(-FORWARD_TASKS // states)))

        def task(item: tuple[int, tuple[int, int]]) -> None:
            b, part = item
            shade(*part, *(x[b] for x in inputs), *fixed, out_covars[b], out_colors[b])

        pool.run(task, [(b, part) for b in range(states) for part in cuts])
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(positions, deformation_gradients, rotations)
            ctx.inputs, ctx.fixed, ctx.pool = inputs, fixed, pool
        return torch.from_numpy(out_covars), torch.from_numpy(out_colors)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_covars: Tensor, grad_colors: Tensor) -> Any:
        positions, deformation_gradients, _ = ctx.saved_tensors
        states, fixed, needed = positions.shape[0], ctx.fixed, ctx.needs_input_grad
        given = array(grad_covars), array(grad_colors)
        cuts = ranges(positions.shape[1], max(1, -(-BACKWARD_TASKS // states)))
        moved = np.empty(positions.shape, np.float32)
        of_units = np.zeros((2, states, len(cuts), *deformation_gradients.shape[1:]), np.float32)

        def task(item: tuple[int, int]) -> None:
            b, part = item
            shade_adjoint(
                *cuts[part], *(x[b] for x in ctx.inputs), *fixed, *(x[b] for x in given), moved[b],
                *of_units[:, b, part],
            )  # fmt: skip

        ctx.pool.run(task, [(b, part) for b in range(states) for part in range(len(cuts))])
        units = of_units[:, :, 0] if len(cuts) == 1 else of_units.sum(2)
        return (
            torch.from_numpy(moved) if needed[0] else None,
            torch.from_numpy(units[0]) if needed[1] else None,
            torch.from_numpy(units[1]) if needed[2] else None,
            *[None] * 5,
        )
