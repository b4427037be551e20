"""Random Gaussians and cameras for benchmarks of the renderer."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Rendered, Renderer
from gausim.ops.covariance import covariance_from_scales

SPREAD = 0.4  # standard deviation of the means [scene units]
DISTANCE = 2.5  # of the cameras from the centre [scene units]
FOCAL = 1.2  # [image widths]
TURN = 0.7  # angle between two cameras [rad]


class Splats(NamedTuple):
    """One state in V views: the arguments of a renderer."""

    means: Float[Tensor, "1 K 3"]
    covars: Float[Tensor, "1 K 3 3"]
    colors: Float[Tensor, "1 V K 3"]
    opacities: Float[Tensor, "1 K"]
    background: Float[Tensor, " 3"]
    viewmats: Float[Tensor, "1 V 4 4"]
    Ks: Float[Tensor, "1 V 3 3"]
    size: tuple[int, int]

    def to(self, device: torch.device) -> Splats:
        """Moves all fields to a device."""
        moved = {name: value.to(device) for name, value in self._asdict().items() if name != "size"}
        return self._replace(**moved)

    @torch.no_grad()
    def forward(self, renderer: Renderer) -> Rendered:
        """Renders without a graph."""
        return self._draw(renderer)

    def both(self, renderer: Renderer, weights: Float[Tensor, "1 V H W 3"]) -> tuple[Tensor, ...]:
        """Gradients of the weighted sum of the images with respect to the first five fields."""
        names = self._fields[:5]
        leaves = {name: getattr(self, name).detach().requires_grad_() for name in names}
        images = self._replace(**leaves)._draw(renderer)
        return torch.autograd.grad([images.rgb], list(leaves.values()), [weights])

    def _draw(self, renderer: Renderer) -> Rendered:
        kernels = self.means, self.covars, self.colors, self.opacities
        return renderer(*kernels, self.viewmats, self.Ks, self.size, background=self.background)

    def weights(self) -> Float[Tensor, "1 V H W 3"]:
        """Random loss gradients with respect to the images."""
        width, height = self.size
        generator = torch.Generator().manual_seed(1)
        shape = (*self.viewmats.shape[:2], height, width, 3)
        return torch.rand(shape, generator=generator).to(self.means.device)


def splats(count: int, width: int, height: int, views: int = 1) -> Splats:
    """A cloud of ``count`` kernels with cameras around it.

    Means are normal, scales log-normal about 0.5 / sqrt(count), so that clouds of any count cover about the same
    fraction of an image; orientations and colours are random, opacities uniform.
    """
    g = torch.Generator().manual_seed(0)
    log_scales = 0.5 * torch.randn(1, count, 3, generator=g) + math.log(0.5 / count**0.5)
    angles = TURN * torch.arange(views, dtype=torch.float32)
    viewmats = torch.eye(4).repeat(1, views, 1, 1)
    viewmats[0, :, 0, 0], viewmats[0, :, 0, 2] = angles.cos(), angles.sin()
    viewmats[0, :, 2, 0], viewmats[0, :, 2, 2] = -angles.sin(), angles.cos()
    viewmats[0, :, 2, 3] = DISTANCE
    focal = FOCAL * width
    intrinsics = torch.tensor([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])
    return Splats(
        means=SPREAD * torch.randn(1, count, 3, generator=g),
        covars=covariance_from_scales(log_scales, torch.randn(1, count, 4, generator=g)),
        colors=torch.rand(1, views, count, 3, generator=g),
        opacities=torch.rand(1, count, generator=g),
        background=torch.tensor([0.1, 0.5, 0.9]),
        viewmats=viewmats,
        Ks=intrinsics.repeat(1, views, 1, 1),
        size=(width, height),
    )
