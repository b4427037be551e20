"""Images that can be computed by hand, for every renderer, and the reference's gradients by finite differences."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from gausim.core import Rendered, Renderer
from gausim.render.cpu import CpuRenderer
from gausim.render.reference import ReferenceRenderer

FOCAL, SIZE = 30.0, (24, 20)
BACKGROUND = (0.2, 0.4, 0.6)

BEHIND = torch.tensor(BACKGROUND, dtype=torch.float64)


@dataclass
class Drawer:
    """A renderer with its floating type and its tolerance."""

    renderer: Renderer
    dtype: torch.dtype
    tolerance: float = 0.0

    def __call__(self, means: Tensor, covars: Tensor, colors: Tensor, alpha: Tensor) -> Rendered:
        """One state seen by two equal cameras at the origin (so that no axis is a singleton but the state's)."""
        intrinsics = torch.tensor([[FOCAL, 0, 12], [0, FOCAL, 10], [0, 0, 1]], dtype=self.dtype)
        kernels = means[None], covars[None], colors.expand(1, 2, -1, 3), alpha[None]
        cameras = torch.eye(4, dtype=self.dtype).expand(1, 2, 4, 4), intrinsics.expand(1, 2, 3, 3)
        return self.renderer(*(x.to(self.dtype) for x in kernels), *cameras, SIZE, background=BEHIND.to(self.dtype))

    def check(self, image: Tensor, expected: Tensor) -> None:
        torch.testing.assert_close(image.double(), expected, atol=self.tolerance, rtol=0)


KINDS = {"reference": (ReferenceRenderer, torch.float64, 1e-12), "cpu": (CpuRenderer, torch.float32, 2e-6)}


@pytest.fixture(params=KINDS)
def drawn(request: pytest.FixtureRequest) -> Drawer:
    kind, dtype, tolerance = KINDS[request.param]
    return Drawer(kind(), dtype, tolerance)


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


def projected(mean: Tensor, covar: Tensor) -> Tensor:
    """The image covariance by the derivative of the pinhole map, here taken by autograd."""
    jacobian = torch.autograd.functional.jacobian(pinhole, mean)
    return jacobian @ covar @ jacobian.T + 0.3 * torch.eye(2, dtype=torch.float64)


def test_round_gaussian_on_the_axis(drawn: Drawer) -> None:
    depth, sigma, opacity = 3.0, 0.2, 0.8
    color = torch.tensor([[0.9, 0.1, 0.3]], dtype=torch.float64)
    images = drawn(
        torch.tensor([[0, 0, depth]]), sigma**2 * torch.eye(3).double()[None], color,
        torch.tensor([opacity], dtype=torch.float64),
    )  # fmt: skip
    covar2d = ((FOCAL * sigma / depth) ** 2 + 0.3) * torch.eye(2, dtype=torch.float64)
    alpha = falloff(pixel_offsets(torch.tensor([12.0, 10.0]).double()), covar2d, opacity)
    assert 0.7 < float(alpha.max()) and float(alpha.min()) == 0
    drawn.check(images.alpha[0, 1], alpha)
    drawn.check(images.rgb[0, 1], alpha[..., None] * color + (1 - alpha[..., None]) * BEHIND)


def test_oblique_gaussian_off_the_axis(drawn: Drawer) -> None:
    mean = torch.tensor([0.5, -0.3, 2.5], dtype=torch.float64)
    factor = torch.tensor([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [-0.2, 0.15, 0.25]], dtype=torch.float64)
    covar, opacity = factor @ factor.T, 0.7
    images = drawn(mean[None], covar[None], torch.ones(1, 3), torch.tensor([opacity], dtype=torch.float64))
    drawn.check(images.alpha[0, 0], falloff(pixel_offsets(pinhole(mean)), projected(mean, covar), opacity))


def test_nearer_gaussian_covers_the_farther_whatever_the_order(drawn: Drawer) -> None:
    means = torch.tensor([[0.1, 0.0, 4.0], [0.0, 0.1, 2.0]]).double()
    covars = torch.stack((0.3**2 * torch.eye(3).double(), 0.1**2 * torch.eye(3).double()))
    colors = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).double()
    opacities = torch.tensor([0.9, 0.6], dtype=torch.float64)
    far, near = (
        falloff(pixel_offsets(pinhole(m)), projected(m, s), float(o))[..., None]
        for m, s, o in zip(means, covars, opacities, strict=True)
    )
    expected = near * colors[1] + (1 - near) * (far * colors[0] + (1 - far) * BEHIND)
    assert float((near * far).max()) > 0.4
    for order in ([0, 1], [1, 0]):
        images = drawn(means[order], covars[order], colors[order], opacities[order])
        drawn.check(images.rgb[0, 0], expected)


def test_kernel_that_would_exhaust_the_pixel_ends_it(drawn: Drawer) -> None:
    """0.005 is left after the first kernel; the second would leave 2.5e-5 < 1e-4: it and the third are not drawn."""
    means = torch.tensor([[0.0, 0.0, z] for z in (2.0, 3.0, 4.0)])
    colors = torch.eye(3).double()
    images = drawn(means, 1e4 * torch.eye(3).repeat(3, 1, 1), colors, torch.tensor([0.995, 0.995, 0.2]))
    expected = 0.995 * colors[0] + 0.005 * BEHIND
    torch.testing.assert_close(images.rgb[0, 0, 10, 12].double(), expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_opacity_has_a_ceiling(kind: str) -> None:
    mean = torch.tensor([[0.5 * 3 / FOCAL, 0.5 * 3 / FOCAL, 3.0]])  # on the centre of pixel (12, 10)
    drawn = Drawer(KINDS[kind][0](), KINDS[kind][1])
    images = drawn(mean, 0.01 * torch.eye(3)[None], torch.ones(1, 3), torch.ones(1))
    assert float(images.alpha.max()) == pytest.approx(0.999, abs=1e-6)


def test_what_cannot_be_seen_leaves_the_background(drawn: Drawer) -> None:
    """Behind the camera, too near, too transparent, out of the image."""
    means = torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.0, 0.009], [0.0, 0.0, 2.0], [9.0, 0.0, 2.0]], requires_grad=True)
    opacities = torch.tensor([0.9, 0.9, 0.0039, 0.9])
    images = drawn(means, 0.01 * torch.eye(3).repeat(4, 1, 1), torch.ones(4, 3), opacities)
    assert float(images.alpha.detach().abs().max()) == 0
    assert torch.equal(images.rgb.detach(), BEHIND.to(drawn.dtype).expand_as(images.rgb))
    images.rgb.sum().backward()
    assert means.grad is not None and float(means.grad.abs().max()) == 0


def test_gradcheck_of_the_reference_with_respect_to_all_inputs(inputs: Callable) -> None:
    """Kernels wide enough that some means lie where the projection is clamped, two states, two views."""
    given = inputs(2, 2, 3, (5, 4), scale=0.25, spread=0.6, seed=3).to(torch.float64)
    given.opacities[:, 0] = 0.97  # below the ceiling: at it the derivative is one-sided

    def images(*tensors: Tensor) -> tuple[Tensor, Tensor]:
        names = "means", "covars", "colors", "opacities", "background"
        drawn = replace(given, **dict(zip(names, tensors, strict=True))).draw(ReferenceRenderer())
        return drawn.rgb, drawn.alpha

    assert torch.autograd.gradcheck(images, tuple(x.requires_grad_() for x in given.tensors), atol=1e-6, fast_mode=True)
