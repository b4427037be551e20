"""Random scenes and cameras for the renderers."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from gausim.core import Cameras, GaussianScene, Rendered, Renderer
from gausim.ops.covariance import covariance_from_scales
from gausim.ops.rotation import rotation_of


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

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        return self.means, self.covars, self.colors, self.opacities, self.background

    def to(self, *kind: torch.dtype | str) -> "Inputs":
        names = ("means", "covars", "colors", "opacities", "viewmats", "Ks", "background")
        return replace(self, **{name: getattr(self, name).detach().to(*kind).clone() for name in names})

    def draw(self, renderer: Renderer) -> Rendered:
        given = *self.tensors[:4], self.viewmats, self.Ks, self.size
        return renderer(*given, background=self.background)

    def draw_with_gradients(self, renderer: Renderer) -> tuple[Rendered, list[Tensor]]:
        """Images and the gradients of a fixed random function of them."""
        leaves = [x.requires_grad_() for x in self.tensors]
        images = self.draw(renderer)
        g = torch.Generator().manual_seed(5)
        loss = sum((x * torch.randn(x.shape, generator=g).to(x)).sum() for x in (images.rgb, images.alpha))
        return images, list(torch.autograd.grad(loss, leaves))


def orbit(views: int, distance: float = 2.5) -> Tensor:
    """World-to-camera matrices around the origin, (V, 4, 4) in float64."""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    for v, viewmat in enumerate(viewmats):
        pitch, yaw = rotation_of(torch.tensor([[0.3 * v, 0, 0], [0, 0.7 * v, 0]], dtype=torch.float64))
        viewmat[:3, :3], viewmat[2, 3] = pitch @ yaw, distance
    return viewmats


# Arguments of make_inputs that strain a renderer in different ways.
CASES = {
    "usual": dict(states=2, views=3, count=300, size=(66, 50)),
    "two_bands": dict(states=2, views=2, count=200, size=(45, 70)),
    "dense": dict(states=2, views=2, count=1500, size=(40, 36), scale=0.05),
    "big": dict(states=2, views=2, count=60, size=(50, 41), scale=0.8),
    "tiny": dict(states=2, views=2, count=400, size=(50, 41), scale=1e-4),
    "around_the_camera": dict(states=2, views=3, count=400, size=(48, 48), spread=2.0),
    "off_screen": dict(states=2, views=2, count=200, size=(30, 30), spread=4.0, scale=0.5),
}


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
        colors=torch.rand(states, views, count, 3, generator=g), opacities=opacities,
        viewmats=orbit(views).float().repeat(states, 1, 1, 1), Ks=intrinsics.repeat(states, views, 1, 1), size=size,
        background=torch.tensor([0.1, 0.5, 0.9]),
    )  # fmt: skip


@pytest.fixture
def inputs() -> Callable[..., Inputs]:
    """Makes random arguments of a renderer."""
    return make_inputs


@pytest.fixture
def case() -> Callable[[str], Inputs]:
    """Makes the arguments of one of the :data:`CASES`."""

    def make(name: str) -> Inputs:
        given = make_inputs(**CASES[name])
        given.opacities[:, 1::9] = 1e-3  # below 1/255
        return given

    return make


@pytest.fixture
def scene() -> Callable[[int, int], GaussianScene]:
    """Makes a random float64 scene of so many kernels and that SH degree."""

    def make(count: int, degree: int) -> GaussianScene:
        g = torch.Generator().manual_seed(degree)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=g, dtype=torch.float64)

        return GaussianScene.create(
            means=0.3 * normal(count, 3), log_scales=0.3 * normal(count, 3) - 2.5, quats=normal(count, 4),
            opacity_logits=normal(count) + 1, sh=0.4 * normal(count, (degree + 1) ** 2, 3),
            foreground=torch.arange(count) % 3 > 0,
        )  # fmt: skip

    return make


@pytest.fixture
def cameras() -> Cameras:
    """Two float64 cameras around the origin."""
    intrinsics = torch.tensor([[40.0, 0, 15], [0, 38, 12], [0, 0, 1]], dtype=torch.float64)
    return Cameras(orbit(2), intrinsics.repeat(2, 1, 1), 31, 22, ("left", "right"))
