"""The CUDA renderer: gsplat's kernels behind core.Renderer."""

import functools
import importlib.util
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import ConfigError, Rendered
from gausim.render.limits import DILATION, NEAR

VERSION = "1.5.3"  # with the ceiling of alpha that is compiled in
DEVICE = "cuda"  # the type of the devices that gsplat draws on
INSTALL = "pip install 'gausim[gpu]'"


def unavailable() -> str | None:
    """The reason, in one line, why gsplat is not usable on this machine; None if it is.

    The conditions are a CUDA device, gsplat in the supported version, and its kernels. A gsplat from the package index
    compiles its kernels at their first import, which takes minutes once per machine.
    """
    if not torch.cuda.is_available():
        return "PyTorch sees no CUDA device (it needs an NVIDIA driver and a CUDA build of torch)"
    if importlib.util.find_spec("gsplat") is None:
        return f"gsplat is not installed ({INSTALL})"
    import gsplat

    if gsplat.__version__.partition("+")[0] != VERSION:
        return f"gsplat is {gsplat.__version__}, expected {VERSION} ({INSTALL})"
    try:
        from gsplat.cuda._backend import _C as kernels
    except Exception as error:  # nvcc, the linker and the loader raise many types; the first line has the cause
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        return f"gsplat's CUDA kernels do not build or load: {reason}"
    if kernels is None:
        return "gsplat finds no CUDA toolkit to build its kernels with (install nvcc of torch's CUDA version)"
    return None


class GsplatRenderer:
    """Gaussian splatting by gsplat's CUDA kernels (core.Renderer, float32 on a CUDA device).

    Conventions are the reference's: the covariance of the image widened by 0.3 pixels^2, contributions below 1/255
    dropped, alpha at most 0.999 (compiled into gsplat, no option here), no kernel skipped for its small radius, no far
    plane within 1e10 scene units. All states and views are one call of gsplat. It waits for the device once per call,
    for the number of tiles that the kernels touch. Values are not checked for being finite.
    """

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
        """Draws B states in V views each (see core.Renderer). Also differentiable in the background.

        Raises:
            ConfigError: gsplat cannot draw on this machine, or a tensor is not float32 on a CUDA device.
        """
        inputs = {"means": means, "covars": covars, "colors": colors, "opacities": opacities}
        for name, value in {**inputs, "viewmats": viewmats, "Ks": Ks}.items():
            if value.dtype != torch.float32 or value.device.type != DEVICE:
                raise ConfigError(
                    f"GsplatRenderer: expected {name} as float32 on a CUDA device, got {value.dtype} on "
                    f"{value.device}. Set trainer=gpu, or use render=cpu for tensors on the CPU."
                )
        behind = means.new_zeros(3) if background is None else background.to(means)
        views = viewmats.shape[:2]
        if means.shape[1] == 0:  # gsplat divides by the number of kernels
            empty = colors.sum()  # zero; it keeps an image without kernels differentiable
            plane = empty.expand(*views, size[1], size[0])
            return Rendered(plane[..., None] + behind, plane)
        image, alpha, _ = self._rasterization(
            means=means,
            quats=None,
            scales=None,
            opacities=opacities,
            colors=colors,
            viewmats=viewmats,
            Ks=Ks,
            width=size[0],
            height=size[1],
            near_plane=NEAR,
            radius_clip=0.0,
            eps2d=DILATION,
            packed=False,
            backgrounds=behind.expand(*views, 3),
            # gsplat reads only the upper triangle; the mean with the transpose makes the loss gradient symmetric.
            covars=0.5 * (covars + covars.mT),
        )
        return Rendered(image, alpha[..., 0])

    @functools.cached_property
    def _rasterization(self) -> Callable[..., Any]:
        reason = unavailable()
        if reason is not None:
            raise ConfigError(
                f"render=gsplat: {reason}. See docs/how-to/gpus-and-clusters.md, or let render=auto choose what this "
                "machine can do."
            )
        from gsplat import rasterization

        return rasterization
