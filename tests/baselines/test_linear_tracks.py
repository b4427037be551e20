"""Linear AR(2) on tracked motion: what was tracked goes on linearly; the basis is smooth and respects pins."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.fitted_methods import recorded, rolled
from helpers.toy_object import toy_scene

from gausim.baselines.linear_tracks import UNIT, LinearTracks
from gausim.core import ConfigError, SimState
from gausim.core.fitted import FittedDynamics

SEEN = 15


def tracks(**options: int) -> LinearTracks:
    settings = {"anchors": 40, "neighbours": 12, "basis": 6, "modes": 2, **options}
    return LinearTracks(**recorded(seen=SEEN), **settings)


def swinging(method: LinearTracks) -> torch.Tensor:
    """Sets the tracked coordinates to two damped swings; returns those of sequence 0 in 40 frames."""
    t = torch.arange(40.0)
    waves = torch.stack((0.97**t * torch.sin(0.5 * t), 0.95**t * torch.sin(0.9 * t)), 1)
    coordinates = torch.zeros(2, 40, method.changes[0].shape[1])
    coordinates[0, :, :2], coordinates[1, :, :2] = 8 * waves, waves * torch.tensor([3.0, -6.0])
    with torch.no_grad():
        for changes, motion in zip(method.changes, coordinates, strict=True):
            changes.copy_(motion[: SEEN + 1].diff(dim=0))
    return coordinates[0]


def test_the_basis_is_of_slow_modes_of_one_size_and_pins_hold() -> None:
    method = tracks()
    basis, anchors = method.get_buffer("basis_0"), method.anchors(0)
    assert basis.shape == (6, len(anchors.rest), 3) and not bool(basis[:, anchors.pinned].any())
    size = basis[:, ~anchors.pinned].square().sum(-1).mean(1).sqrt()
    assert float(size[0]) == pytest.approx(UNIT, rel=1e-4) and bool((size.diff() <= 1e-6).all())
    assert torch.equal(basis, tracks().get_buffer("basis_0"))  # the same in every process


def test_training_shows_the_tracks_and_evaluation_the_linear_model() -> None:
    method = tracks()
    coordinates, rest = swinging(method), toy_scene().means
    method.train()
    states, energy = rolled(method, SEEN), method.penalties(0)["energy"]
    assert float(energy.detach()) == pytest.approx(float(coordinates[1 : SEEN + 1].square().sum(1).mean()), rel=1e-4)
    for frame, state in enumerate(states[1:], 1):
        motion = torch.einsum("m,mai->ai", coordinates[frame], method.get_buffer("basis_0"))
        torch.testing.assert_close(state.positions, method.anchors(0).positions(motion), atol=1e-6, rtol=0)
    (state.positions - rest).square().sum().backward()
    assert bool((method.changes[0].grad.abs().sum(1) > 0).all()) and method.changes[1].grad is None

    method.eval()
    with torch.no_grad():
        predicted = FittedDynamics(method, 0).rollout(SimState(rest, rest), 39).positions
        motion = torch.einsum("fm,mai->fai", coordinates, method.get_buffer("basis_0"))
        truth = torch.stack([method.anchors(0).positions(x) for x in motion])
    swing = float((truth - rest).norm(dim=-1).max())
    assert float((predicted - truth).norm(dim=-1).max()) < 0.01 * swing and math.isfinite(swing)


def test_frames_beyond_the_first_two_follow_the_fit_not_the_tracks() -> None:
    method = tracks(modes=1)  # too few for two swings
    swinging(method)
    method.eval()
    with torch.no_grad():
        tracked = method.tracked(0)
        shown = [s.inner[0][1] for s in rolled(method, 3)[1:]]
    torch.testing.assert_close(shown[0], tracked[1])
    assert float((shown[2] - tracked[3]).abs().max()) > 0.05 * float(tracked[3].abs().max())


def test_wrong_settings_name_their_field() -> None:
    with pytest.raises(ConfigError, match=r"model\.method: expected neighbours, basis, modes >= 1"):
        tracks(modes=0)
    with pytest.raises(ConfigError, match=r"model\.method\.anchors"):
        tracks(anchors=2)
