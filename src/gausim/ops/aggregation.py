"""Sums of values over the members of each unit."""

# The kernels carry no annotations: numba has to compile them as they are.
# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.kernels.compiled import array, fits
from gausim.kernels.jit import KERNEL, ORDERED


@numba.njit(fastmath=ORDERED, **KERNEL)
def _sum(values, weights, index, total):
    for i in range(values.shape[0]):
        c, w = index[i], weights[i]
        total[c, 0] += w * values[i, 0]
        total[c, 1] += w * values[i, 1]
        total[c, 2] += w * values[i, 2]


@numba.njit(fastmath=ORDERED, **KERNEL)
def _sum_adjoint(values, weights, index, grad, grad_values, grad_weights):
    for i in range(values.shape[0]):
        c, w = index[i], weights[i]
        x, y, z = grad[c, 0], grad[c, 1], grad[c, 2]
        grad_values[i, 0], grad_values[i, 1], grad_values[i, 2] = w * x, w * y, w * z
        grad_weights[i] = values[i, 0] * x + values[i, 1] * y + values[i, 2] * z


class _WeightedSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, weights: Tensor, index: Tensor, count: int) -> Tensor:
        total = np.zeros((count, 3), np.float32)
        _sum(array(values), array(weights), array(index), total)
        ctx.save_for_backward(values, weights, index)
        return torch.from_numpy(total)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:
        values, weights, index = ctx.saved_tensors
        grad_values = np.empty(values.shape, np.float32)
        grad_weights = np.empty(weights.shape, np.float32)
        _sum_adjoint(array(values), array(weights), array(index), array(grad), grad_values, grad_weights)
        return torch.from_numpy(grad_values), torch.from_numpy(grad_weights), None, None


def weighted_sum(
    values: Float[Tensor, "K 3"], weights: Float[Tensor, " K"], index: Int[Tensor, " K"], count: int
) -> Float[Tensor, "N 3"]:
    """Sum of w_k y_k over the members k of each of ``count`` units; ``index`` holds the unit of every member."""
    if fits(values, weights):
        return _WeightedSum.apply(values, weights, index, count)
    return values.new_zeros(count, 3).index_add(0, index, values * weights[:, None])
