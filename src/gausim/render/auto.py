"""Choice of the renderer by device: gsplat on CUDA, the compiled CPU renderer elsewhere."""

import functools
import logging
from typing import Any

import torch
from torch import Tensor

from gausim.core import Rendered
from gausim.render import gsplat
from gausim.render.cpu import CpuRenderer

logger = logging.getLogger(__name__)


class AutoRenderer:
    """Draws tensors on the CPU with CpuRenderer and tensors on a CUDA device with GsplatRenderer (core.Renderer).

    Where the tensors are on a CUDA device but gsplat is not usable, images are drawn on the CPU and copied back: far
    faster than plain torch on the device, but the device waits. The choice is logged once per process and type of
    device, with the reason where gsplat is not used.
    """

    def __init__(self, *, threads: int | None = None) -> None:
        """``threads`` are those of :class:`CpuRenderer`."""
        self.cpu, self.gsplat = CpuRenderer(threads=threads), gsplat.GsplatRenderer()

    def __call__(self, means: Tensor, *inputs: Any, background: Tensor | None = None) -> Rendered:
        """Draws B states in V views each; the arguments are those of core.Renderer."""
        if chosen(means.device.type) == "gsplat":
            return self.gsplat(means, *inputs, background=background)
        *tensors, size = inputs
        kernels, covars, colors, opacities, viewmats, Ks = (value.cpu() for value in (means, *tensors))
        behind = None if background is None else background.cpu()
        images = self.cpu(kernels, covars, colors, opacities, viewmats, Ks, size, background=behind)
        return Rendered(images.rgb.to(means.device), images.alpha.to(means.device))


@functools.cache
def chosen(device: str) -> str:
    """Name of the renderer for tensors on this type of device, ``gsplat`` or ``cpu``; the first call logs it."""
    if device == "cpu":
        reason = "the tensors are on the CPU" if torch.cuda.is_available() else "PyTorch sees no CUDA device"
        logger.info("render=auto: images are drawn by the CPU renderer, not by gsplat: %s.", reason)
        return "cpu"
    reason_against = gsplat.unavailable()
    if reason_against is None:
        logger.info("render=auto: images are drawn by gsplat on the GPU.")
        return "gsplat"
    logger.warning(
        "render=auto: images are drawn on the CPU and copied back to %s, which is slow, because %s.",
        device,
        reason_against,
    )
    return "cpu"
