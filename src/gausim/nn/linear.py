"""Linear layers through oneDNN, whose float32 product is up to twice as fast as torch's default on the CPU."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

# Below this many multiplications the call itself costs more than the product.
SMALLEST = 1 << 20


def has_onednn(tensor: Tensor) -> bool:
    """Whether products of ``tensor`` go through oneDNN's kernel.

    torch sends float32 products to MKL, which leaves half of the vector width of AMD's processors unused; oneDNN does
    not (107 against 235 GFLOP/s on one core of Zen 5). torch sends bfloat16 to oneDNN by itself.
    """
    return tensor.dtype == torch.float32 and tensor.device.type == "cpu" and torch.backends.mkldnn.is_available()


def product(
    inputs: Float[Tensor, "N I"],
    weight: Float[Tensor, "O I"],
    bias: Float[Tensor, " O"] | None = None,
) -> Float[Tensor, "N O"]:
    """``inputs @ weight.T + bias`` by oneDNN; not differentiable, transposed views are taken as they are."""
    return torch.ops.mkldnn._linear_pointwise(inputs, weight, bias, "none", [], "")


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        inputs = inputs.contiguous()  # oneDNN takes a transposed view in the backward pass, but no expanded one
        ctx.save_for_backward(inputs, weight)
        return product(inputs, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        inputs, weight = ctx.saved_tensors
        return (
            product(grad, weight.t()) if ctx.needs_input_grad[0] else None,
            product(grad.t(), inputs.t()) if ctx.needs_input_grad[1] else None,
            grad.sum(0) if ctx.needs_input_grad[2] else None,
        )


class Linear(nn.Linear):
    """``torch.nn.Linear`` whose large float32 products on the CPU, and their gradients, go through oneDNN.

    Elsewhere (other devices and types, autocast, torch.compile, small inputs) it is the base class. The large products
    have first derivatives only.
    """

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 - the base class's name
        """``input @ weight.T + bias``."""
        # The size comes last: a compiler that asked for it would compile once more per answer.
        if torch.compiler.is_compiling() or torch.is_autocast_enabled("cpu") or not has_onednn(input):
            return super().forward(input)
        if input.dim() != 2 or input.shape[0] * self.weight.numel() < SMALLEST:
            return super().forward(input)
        result: Tensor = _Linear.apply(input, self.weight, self.bias)
        return result
