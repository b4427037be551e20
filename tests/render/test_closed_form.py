"""Images that can be computed by hand, for every renderer."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gausim.core import Rendered, Renderer
from gausim.render.cpu import CpuRenderer
from gausim.render.reference import ReferenceRenderer

FOCAL, SIZE = 30.0, (24, 20)
BACKGROUND = (0.2, 0.4, 0.6)

RENDERERS = [
    pytest.param(ReferenceRenderer(), torch.float64, 1e-12, id="reference"),
    pytest.param(CpuRenderer(threads=1), torch.float32, 2e-6, id="cpu"),
]
each_renderer = pytest.mark.parametrize(("renderer", "dtype", "tolerance"), RENDERERS)


def draw(
    renderer: Renderer, dtype: torch.dtype, means: Tensor, covars: Tensor, colors: Tensor, alpha: Tensor
) -> Rendered:
    """One state seen by two equal cameras at the origin (so that no axis is a singleton but the state's)."""
    intrinsics = torch.tensor([[FOCAL, 0, 12], [0, FOCAL, 10], [0, 0, 1]], dtype=dtype)
    return renderer(
        means[None].to(dtype),
        covars[None].to(dtype),
        colors.to(dtype).expand(1, 2, -1, 3),
        alpha[None].to(dtype),
        torch.eye(4, dtype=dtype).expand(1, 2, 4, 4),
        intrinsics.expand(1, 2, 3, 3),
        SIZE,
        background=torch.tensor(BACKGROUND, dtype=dtype),
    )


def pixel_offsets(mean2d: Tensor) -> Tensor:
    """From an image point to every pixel centre, (H, W, 2)."""
    y, x = torch.meshgrid(torch.arange(SIZE[1]) + 0.5, torch.arange(SIZE[0]) + 0.5, indexing="ij")
    return torch.stack((x, y), -1).double() - mean2d


def falloff(offsets: Tensor, covar2d: Tensor, opacity: float) -> Tensor:
    power = torch.einsum("hwi,ij,hwj->hw", offsets, torch.linalg.inv(covar2d), offsets)
    alpha = opacity * torch.exp(-0.5 * power)
    return torch.where(alpha >= 1 / 255, alpha, 0.0)


def pinhole(point: Tensor) -> Tensor:
    return FOCAL * point[:2] / point[2] + torch.tensor([12.0, 10.0], dtype=torch.float64)


@each_renderer
def test_round_gaussian_on_the_axis(renderer: Renderer, dtype: torch.dtype, tolerance: float) -> None:
    depth, sigma, opacity = 3.0, 0.2, 0.8
    color = torch.tensor([[0.9, 0.1, 0.3]], dtype=torch.float64)
    images = draw(
        renderer,
        dtype,
        torch.tensor([[0, 0, depth]]),
        sigma**2 * torch.eye(3).double()[None],
        color,
        torch.tensor([opacity], dtype=torch.float64),
    )
    covar2d = ((FOCAL * sigma / depth) ** 2 + 0.3) * torch.eye(2, dtype=torch.float64)
    alpha = falloff(pixel_offsets(torch.tensor([12.0, 10.0]).double()), covar2d, opacity)
    expected = alpha[..., None] * color + (1 - alpha[..., None]) * torch.tensor(BACKGROUND, dtype=torch.float64)
    assert 0.7 < float(alpha.max()) and float(alpha.min()) == 0
    torch.testing.assert_close(images.alpha[0, 1].double(), alpha, atol=tolerance, rtol=0)
    torch.testing.assert_close(images.rgb[0, 1].double(), expected, atol=tolerance, rtol=0)


@each_renderer
def test_oblique_gaussian_off_the_axis(renderer: Renderer, dtype: torch.dtype, tolerance: float) -> None:
    """The image covariance is that of the pinhole map's derivative, here taken by autograd."""
    mean = torch.tensor([0.5, -0.3, 2.5], dtype=torch.float64)
    factor = torch.tensor([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [-0.2, 0.15, 0.25]], dtype=torch.float64)
    covar, opacity = factor @ factor.T, 0.7
    images = draw(
        renderer, dtype, mean[None], covar[None], torch.ones(1, 3), torch.tensor([opacity], dtype=torch.float64)
    )
    jacobian = torch.autograd.functional.jacobian(pinhole, mean)
    covar2d = jacobian @ covar @ jacobian.T + 0.3 * torch.eye(2, dtype=torch.float64)
    alpha = falloff(pixel_offsets(pinhole(mean)), covar2d, opacity)
    torch.testing.assert_close(images.alpha[0, 0].double(), alpha, atol=tolerance, rtol=0)


@each_renderer
def test_nearer_gaussian_covers_the_farther_whatever_the_order(
    renderer: Renderer, dtype: torch.dtype, tolerance: float
) -> None:
    means = torch.tensor([[0.1, 0.0, 4.0], [0.0, 0.1, 2.0]]).double()
    covars = torch.stack((0.3**2 * torch.eye(3).double(), 0.1**2 * torch.eye(3).double()))
    colors = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).double()
    opacities = torch.tensor([0.9, 0.6], dtype=torch.float64)
    far, near = (
        falloff(pixel_offsets(pinhole(m)), j @ s @ j.T + 0.3 * torch.eye(2, dtype=torch.float64), float(o))[..., None]
        for m, s, o in zip(means, covars, opacities, strict=True)
        for j in [torch.autograd.functional.jacobian(pinhole, m)]
    )
    behind = torch.tensor(BACKGROUND, dtype=torch.float64)
    expected = near * colors[1] + (1 - near) * (far * colors[0] + (1 - far) * behind)
    assert float((near * far).max()) > 0.4
    for order in ([0, 1], [1, 0]):
        images = draw(renderer, dtype, means[order], covars[order], colors[order], opacities[order])
        torch.testing.assert_close(images.rgb[0, 0].double(), expected, atol=tolerance, rtol=0)


@each_renderer
def test_kernel_that_would_exhaust_the_pixel_ends_it(renderer: Renderer, dtype: torch.dtype, tolerance: float) -> None:
    """0.005 is left after the first kernel; the second would leave 2.5e-5 < 1e-4: it and the third are not drawn."""
    means = torch.tensor([[0.0, 0.0, z] for z in (2.0, 3.0, 4.0)])
    covars = 1e4 * torch.eye(3).repeat(3, 1, 1)
    colors = torch.eye(3)
    images = draw(renderer, dtype, means, covars, colors, torch.tensor([0.995, 0.995, 0.2]))
    middle = images.rgb[0, 0, 10, 12].double()
    expected = 0.995 * colors[0].double() + 0.005 * torch.tensor(BACKGROUND, dtype=torch.float64)
    torch.testing.assert_close(middle, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("alpha_max", [0.999, 0.9])
@pytest.mark.parametrize(("kind", "dtype"), [(ReferenceRenderer, torch.float64), (CpuRenderer, torch.float32)])
def test_opacity_has_a_ceiling(kind: type, dtype: torch.dtype, alpha_max: float) -> None:
    mean = torch.tensor([[0.5 * 3 / FOCAL, 0.5 * 3 / FOCAL, 3.0]])  # on the centre of pixel (12, 10)
    images = draw(kind(alpha_max=alpha_max), dtype, mean, 0.01 * torch.eye(3)[None], torch.ones(1, 3), torch.ones(1))
    assert float(images.alpha.max()) == pytest.approx(alpha_max, abs=1e-6)


@each_renderer
def test_what_cannot_be_seen_leaves_the_background(renderer: Renderer, dtype: torch.dtype, tolerance: float) -> None:
    """Behind the camera, too near, too transparent, out of the image."""
    means = torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.0, 0.009], [0.0, 0.0, 2.0], [9.0, 0.0, 2.0]], requires_grad=True)
    opacities = torch.tensor([0.9, 0.9, 0.0039, 0.9])
    images = draw(renderer, dtype, means, 0.01 * torch.eye(3).repeat(4, 1, 1), torch.ones(4, 3), opacities)
    assert float(images.alpha.detach().abs().max()) == 0
    assert torch.equal(images.rgb.detach(), torch.tensor(BACKGROUND, dtype=dtype).expand_as(images.rgb))
    images.rgb.sum().backward()
    assert means.grad is not None and float(means.grad.abs().max()) == 0
