"""Random scenes and cameras for the renderers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from gausim.core import Cameras, GaussianScene, Rendered, Renderer
from gausim.ops.covariance import covariance_from_scales


@dataclass
class Inputs:
    """The arguments of a renderer."""

    means: Tensor
    covars: Tensor
    colors: Tensor
    opacities: Tensor
    viewmats: Tensor
    Ks: Tensor
    size: tuple[int, int]
    background: Tensor
    depth: bool = False

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        return self.means, self.covars, self.colors, self.opacities, self.background

    def to(self, dtype: torch.dtype) -> Inputs:
        names = ("means", "covars", "colors", "opacities", "viewmats", "Ks", "background")
        return replace(self, **{name: getattr(self, name).detach().to(dtype).clone() for name in names})

    def draw(self, renderer: Renderer) -> Rendered:
        given = *self.tensors[:4], self.viewmats, self.Ks, self.size
        return renderer(*given, background=self.background, depth=self.depth)

    def draw_with_gradients(self, renderer: Renderer) -> tuple[Rendered, list[Tensor]]:
        """Images and the gradients of a fixed random function of them."""
        leaves = [x.requires_grad_() for x in self.tensors]
        images = self.draw(renderer)
        generator = torch.Generator().manual_seed(5)
        weight_rgb = torch.randn(images.rgb.shape, generator=generator).to(images.rgb)
        weight_alpha = torch.randn(images.alpha.shape, generator=generator).to(images.rgb)
        loss = (images.rgb * weight_rgb).sum() + (images.alpha * weight_alpha).sum()
        if images.depth is not None:
            loss = loss + (images.depth * torch.randn(images.depth.shape, generator=generator).to(images.rgb)).sum()
        return images, list(torch.autograd.grad(loss, leaves))


def orbit(views: int, distance: float = 2.5) -> Tensor:
    """World-to-camera matrices around the origin, (V, 4, 4) in float64."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    for v in range(views):
        a, b = 0.7 * v, 0.3 * v
        yaw = [[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]]
        pitch = [[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]]
        viewmats[v, :3, :3] = torch.tensor(pitch, dtype=torch.float64) @ torch.tensor(yaw, dtype=torch.float64)
        viewmats[v, 2, 3] = distance
    return viewmats


def make_inputs(
    states: int,
    views: int,
    count: int,
    size: tuple[int, int],
    *,
    scale: float = 0.03,
    spread: float = 0.4,
    seed: int = 0,
) -> Inputs:
    """Random kernels of about ``scale`` in a cloud of about ``spread``, opacities 0..1 with some exactly 1."""
    g = torch.Generator().manual_seed(seed)
    log_scales = torch.randn(states, count, 3, generator=g) * 0.5 + math.log(scale)
    opacities = torch.rand(states, count, generator=g)
    opacities[:, ::7] = 1.0
    width, height = size
    focal = 1.2 * width
    intrinsics = torch.tensor([[focal, 0, 0.48 * width], [0, 0.95 * focal, 0.53 * height], [0, 0, 1]])
    return Inputs(
        means=torch.randn(states, count, 3, generator=g) * spread,
        covars=covariance_from_scales(log_scales, torch.randn(states, count, 4, generator=g)),
        colors=torch.rand(states, views, count, 3, generator=g),
        opacities=opacities,
        viewmats=orbit(views).float().repeat(states, 1, 1, 1),
        Ks=intrinsics.repeat(states, views, 1, 1),
        size=size,
        background=torch.tensor([0.1, 0.5, 0.9]),
    )


@pytest.fixture
def inputs() -> Callable[..., Inputs]:
    """Makes random arguments of a renderer."""
    return make_inputs


@pytest.fixture
def scene() -> Callable[[int, int], GaussianScene]:
    """Makes a random float64 scene of so many kernels and that SH degree."""

    def make(count: int, degree: int) -> GaussianScene:
        g = torch.Generator().manual_seed(degree)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=g, dtype=torch.float64)

        return GaussianScene.create(
            means=0.3 * normal(count, 3),
            log_scales=0.3 * normal(count, 3) - 2.5,
            quats=normal(count, 4),
            opacity_logits=normal(count) + 1,
            sh=0.4 * normal(count, (degree + 1) ** 2, 3),
            foreground=torch.arange(count) % 3 > 0,
        )

    return make


@pytest.fixture
def cameras() -> Cameras:
    """Two float64 cameras around the origin."""
    intrinsics = torch.tensor([[40.0, 0, 15], [0, 38, 12], [0, 0, 1]], dtype=torch.float64)
    return Cameras(orbit(2), intrinsics.repeat(2, 1, 1), 31, 22, ("left", "right"))
