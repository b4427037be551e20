"""Deformed scenes: covariances, colours by direction, masks, trajectories."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gausim.core import Cameras, ConfigError, Rendered, Trajectory
from gausim.ops.rotation import quaternion_to_matrix
from gausim.ops.spherical_harmonics import evaluate_sh
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import SceneAppearance, deformed_appearance, draw, film, to_bytes
from gausim.render.reference import ReferenceRenderer

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
