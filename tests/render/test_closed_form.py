"""Images that can be computed by hand, for every renderer, and the reference's gradients by finite differences."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from benchmarks.reference_renderer import ReferenceRenderer
from gausim.core import Cameras, ConfigError, Rendered, Renderer, Trajectory
from gausim.ops.rotation import quaternion_to_matrix
from gausim.ops.spherical_harmonics import evaluate_sh
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import SceneAppearance, deformed_appearance, draw, film, to_bytes

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


COUNT, UNITS = 12, 3


@pytest.fixture
def units() -> Tensor:
    return torch.arange(COUNT) % UNITS


def deformation(states: int) -> tuple[Tensor, Tensor]:
    """Random gradients near a rotation and these rotations, (B, N, 3, 3)."""
    g = torch.Generator().manual_seed(1)
    rotations = quaternion_to_matrix(torch.randn(states, UNITS, 4, generator=g, dtype=torch.float64))
    stretch = torch.eye(3).double() + 0.2 * torch.randn(states, UNITS, 3, 3, generator=g, dtype=torch.float64)
    return rotations @ stretch, rotations


@pytest.mark.parametrize("degree", [0, 3])
def test_rotating_scene_and_cameras_together_changes_nothing(scene, cameras, units, degree) -> None:
    still = scene(COUNT, degree)
    rest = still.means.expand(2, -1, -1)
    identity = torch.eye(3).double().expand(2, UNITS, 3, 3)
    expected = draw(ReferenceRenderer(), still, rest, identity, identity, units, cameras)
    turn = quaternion_to_matrix(torch.tensor([0.3, -0.5, 0.7, 0.2]).double())
    shift = torch.tensor([0.4, -0.2, 0.9]).double()
    turned = turn.expand(2, UNITS, 3, 3)
    undo = torch.eye(4).double()
    undo[:3, :3], undo[:3, 3] = turn.T, -turn.T @ shift
    moved = replace(cameras, viewmats=cameras.viewmats @ undo)
    images = draw(ReferenceRenderer(), still, rest @ turn.T + shift, turned, turned, units, moved)
    torch.testing.assert_close(images.rgb, expected.rgb, atol=1e-10, rtol=0)
    assert float(expected.alpha.max()) > 0.5
    if degree:  # colours that stayed behind would show
        behind = draw(ReferenceRenderer(), still, rest @ turn.T + shift, turned, identity, units, moved)
        assert float((behind.rgb - expected.rgb).abs().max()) > 1e-2


@pytest.mark.parametrize("degree", [1, 3])
def test_colours_are_looked_up_along_the_unrotated_direction(scene, cameras, units, degree) -> None:
    still = scene(COUNT, degree)
    positions = torch.randn(2, COUNT, 3, dtype=torch.float64)
    _, rotations = deformation(2)
    look = SceneAppearance.of(still)
    _, colors = deformed_appearance(positions, rotations, rotations, units, look.covars, look.sh, cameras.centers)
    for b, v, k in ((0, 0, 0), (1, 0, 7), (1, 1, 5)):
        away = torch.nn.functional.normalize(positions[b, k] - cameras.centers[v], dim=-1)
        expected = evaluate_sh(still.sh[k], rotations[b, units[k]].T @ away)
        torch.testing.assert_close(colors[b, v, k], expected, atol=1e-12, rtol=0)


def test_gradients_reach_positions_gradients_and_rotations(scene: Callable, cameras: Cameras, units: Tensor) -> None:
    look = SceneAppearance.of(scene(COUNT, 1))
    small = replace(cameras, width=8, height=6, Ks=cameras.Ks * torch.tensor([0.25, 0.25, 1]).double()[:, None])
    deformation_gradients, rotations = deformation(2)
    positions = 0.3 * torch.randn(2, COUNT, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))

    def image(positions: Tensor, deformation_gradients: Tensor, rotations: Tensor) -> Tensor:
        return draw(ReferenceRenderer(), look, positions, deformation_gradients, rotations, units, small).rgb

    given = tuple(x.clone().requires_grad_() for x in (positions, deformation_gradients, rotations))
    assert torch.autograd.gradcheck(image, given, atol=1e-6, fast_mode=True)
    assert all(float(g.abs().max()) > 0 for g in torch.autograd.grad(image(*given).sum(), given))


def test_mask_draws_the_kernels_it_names(scene: Callable, cameras: Cameras, units: Tensor) -> None:
    still = scene(COUNT, 2)
    turns, positions, mask = deformation(2), still.means.expand(2, -1, -1), still.foreground

    def image(look: object, positions: Tensor, units: Tensor, **options: Tensor) -> Tensor:
        return draw(ReferenceRenderer(), look, positions, *turns, units, cameras, **options).rgb

    expected = image(still.select(mask), positions[:, mask], units[mask])
    assert torch.equal(image(still, positions, units, mask=mask), expected)
    assert float((image(still, positions, units) - expected).abs().max()) > 1e-2
    with pytest.raises(ConfigError, match="SceneAppearance.of"):
        image(SceneAppearance.of(still), positions, units, mask=mask)


def test_trajectory_is_drawn_chunk_by_chunk(scene: Callable, cameras: Cameras, units: Tensor, monkeypatch) -> None:
    still = scene(COUNT, 1)
    deformation_gradients, rotations = (x.float() for x in deformation(5))
    positions = (still.means + torch.linspace(0, 0.2, 5)[:, None, None]).float()
    trajectory = Trajectory(positions, deformation_gradients, rotations, units, 24.0)
    renderer = CpuRenderer(threads=1)
    behind = torch.tensor([1.0, 1.0, 1.0])
    expected = draw(renderer, still, positions, deformation_gradients, rotations, units, cameras, background=behind).rgb
    drawn = []

    def noted(means: Tensor, *inputs: object, **options: object) -> Rendered:
        drawn.append(len(means))
        return renderer(means, *inputs, **options)

    monkeypatch.setattr("gausim.render.draw.AT_A_TIME", 2)
    frames = film(noted, still, trajectory, cameras, background=behind)
    assert drawn == [2, 2, 1] and torch.equal(frames, to_bytes(expected))
    assert float((frames.float() / 255 - expected.clamp(0, 1)).abs().max()) <= 0.5 / 255 + 1e-6
    assert math.isclose(float(frames.max()), 255)
