"""Models with memory: earlier frames among the inputs, carried along by rollouts."""

from dataclasses import replace

import pytest
import torch
from helpers.bodies import make_model, make_scene, make_state

from gausim.core import ConfigError, SimState
from gausim.core.surroundings import Surroundings
from gausim.models.rollout.dynamics import SceneDynamics


def test_unknown_frames_continue_backwards_and_memory_is_refused_where_bodies_move() -> None:
    x = torch.arange(12.0).view(4, 3)
    step = torch.ones(4, 3)
    older = SimState(x, x - step).remembering(2).older
    assert all(torch.equal(a, b) for a, b in zip(older, (x - 2, x - 3), strict=True))
    known = SimState(x, x - step, (x - 5 * step,)).remembering(3).older
    assert all(torch.equal(a, b) for a, b in zip(known, (x - 5, x - 9, x - 13), strict=True))
    assert SimState(x, x, (x, x)).remembering(1).older[0] is x and SimState(x, x).remembering(0).older == ()
    free = replace(make_scene(60), surroundings=Surroundings(free=True))
    with pytest.raises(ConfigError, match=r"history: expected 0 where bodies are free"):
        make_model(free, history=2)
    with pytest.raises(ConfigError, match=r"history: expected at least 0, got -1"):
        make_model(make_scene(60), history=-1)


def test_a_rollout_carries_the_frames_that_the_network_sees() -> None:
    torch.manual_seed(0)
    scene = make_scene(60)
    model = make_model(scene, history=2).eval()
    assert model.predictor.features.node_normalised == 6 + 6
    batch, state = model.batch((0,)), make_state(scene)
    first = model.step(batch, state)
    even = model.step(batch, state.remembering(2))
    assert torch.equal(first.positions, even.positions)
    after = first.following(state)
    assert torch.equal(after.positions, first.positions) and torch.equal(after.previous, state.positions)
    assert torch.equal(after.older[0], state.previous) and len(after.older) == 2
    other = replace(after, older=(after.older[0], after.older[1] + 0.1))
    assert not torch.allclose(model.step(batch, after).positions, model.step(batch, other).positions)
    with torch.no_grad():
        twice = model.step(batch, after).positions
    assert torch.allclose(SceneDynamics(model).rollout(state, 2).positions[2], twice, atol=1e-6)
