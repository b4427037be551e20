"""The CPU renderer as a differentiable operation of torch."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import ConfigError, Rendered
from gausim.kernels.announce import announced
from gausim.kernels.operations import array
from gausim.kernels.pool import shared_pool
from gausim.render.cpu.batch import Batch, Images


class _Render(torch.autograd.Function):
    """The batch as one node of the autograd graph."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, covars: Tensor, colors: Tensor, opacities: Tensor, background: Tensor, *rest: Any
    ) -> Any:
        pool, keep, viewmats, Ks, *options = rest
        arrays: Any = map(array, (means, covars, colors, opacities, viewmats, Ks, background))
        batch = Batch(*arrays, *options)
        images = batch.forward(pool, keep=keep)
        if keep:
            ctx.save_for_backward(means, covars, colors, opacities, background)
            ctx.batch, ctx.pool = batch, pool
            ctx.set_materialize_grads(False)
        return tuple(map(torch.from_numpy, images))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_rgb: Tensor | None, grad_alpha: Tensor | None) -> Any:
        _ = ctx.saved_tensors  # raises if an input was changed in place since then: the batch uses the same memory
        batch, needed = ctx.batch, ctx.needs_input_grad[:5]
        shape = (*batch.viewmats.shape[:2], batch.height, batch.width)
        images = Images(
            np.zeros((*shape, 3), np.float32) if grad_rgb is None else array(grad_rgb),
            np.zeros(shape, np.float32) if grad_alpha is None else array(grad_alpha),
        )
        grads = batch.backward(ctx.pool, images, background=needed[4])
        return (
            *(torch.from_numpy(grad) if need else None for grad, need in zip(grads, needed, strict=True)),
            *[None] * 7,
        )


class CpuRenderer:
    """Gaussian splatting compiled by numba for the processor at hand (core.Renderer, float32).

    Tile-based EWA splatting with analytic loss gradients. Results are the same to the bit for any number of threads.
    The first call compiles for some seconds; numba's cache keeps the compiled code.
    """

    def __init__(self, *, threads: int | None = None) -> None:
        """``threads`` are worker threads; None means torch.get_num_threads() at the time of each call.

        Raises:
            ConfigError: fewer than one.
        """
        if threads is not None and threads < 1:
            raise ConfigError(f"render.threads: expected at least 1, got {threads}.")
        self.threads = threads

    def __call__(
        self,
        means: Float[Tensor, "B K 3"],
        covars: Float[Tensor, "B K 3 3"],
        colors: Float[Tensor, "B V K 3"],
        opacities: Float[Tensor, "B K"],
        viewmats: Float[Tensor, "B V 4 4"],
        Ks: Float[Tensor, "B V 3 3"],
        size: tuple[int, int],
        *,
        background: Float[Tensor, " 3"] | None = None,
    ) -> Rendered:
        """Draws B states in V views each (see core.Renderer). Tensors must be float32 on the CPU.

        Raises:
            ConfigError: a tensor is not float32 or not on the CPU.
            DivergenceError: a Gaussian is not finite or its opacity lies outside 0..1.
        """
        inputs = {"means": means, "covars": covars, "colors": colors, "opacities": opacities}
        for name, value in {**inputs, "viewmats": viewmats, "Ks": Ks}.items():
            if value.dtype != torch.float32 or value.device.type != "cpu":
                raise ConfigError(
                    f"CpuRenderer: expected {name} as float32 on the CPU, got {value.dtype} on {value.device}. "
                    "Convert it."
                )
        behind = torch.from_numpy(np.zeros(3, np.float32)) if background is None else background.to(means)
        inputs["background"] = behind
        keep = torch.is_grad_enabled() and any(value.requires_grad for value in inputs.values())
        pool = shared_pool(self.threads or torch.get_num_threads())
        with announced("the CPU renderer"):
            return Rendered(*_Render.apply(*inputs.values(), pool, keep, viewmats, Ks, *size))
