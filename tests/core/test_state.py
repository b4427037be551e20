"""States to begin a rollout with."""

from __future__ import annotations

import pytest
import torch
from helpers.toy_object import toy_scene

from gausim.core.state import initial_sway


def test_sway_grows_from_the_roots() -> None:
    scene = toy_scene()
    state = initial_sway(scene, 0.01)
    shift = (state.positions - state.previous)[:, 0]
    assert (shift[scene.pinned] == 0).all() and (shift[~scene.pinned] > 0).all()
    assert float(shift.max()) == pytest.approx(0.01 * scene.diagonal, rel=1e-5)
    assert torch.equal(state.positions, scene.means)
