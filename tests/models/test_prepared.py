"""What steps share: the same as constants of their own, for one batch, and the same bits every time."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gausim.core import SimState
from gausim.models.template.elastic import ElasticTemplate

NAMES = ("positions", "deformation_gradients", "rotations", "momentum")


def _rollout(model, batch, state: SimState, *, share: bool, steps: int = 3) -> list[Tensor]:
    prepared, made = model.prepare(batch) if share else None, []
    for _ in range(steps):
        made.append(model.step(batch, state, None, prepared))
        state = SimState(made[-1].positions, state.positions)
    return [getattr(step, name) for step in made for name in NAMES]


OPTIONS = [
    {},
    {"predicted_levels": (0,), "graph_radii": (0.3,)},
    {"rest_inputs": True, "edges": "rest", "template": partial(ElasticTemplate, modes=5, neighbours=6)},
    {"coarse_inputs": True, "angle": "inner", "conserve_mass": False, "gravity": (0.0, 1.0, -3.0)},
]


@pytest.mark.parametrize("options", OPTIONS, ids=["paper", "no_hierarchy", "elastic", "other_readings"])
def test_steps_that_share_constants_equal_steps_of_their_own(make_scene, make_model, make_state, options) -> None:
    scene = make_scene(70)
    model = make_model(scene, output_scale=0.5, **options)
    batch, state = model.batch((0,)), make_state(scene)
    results = []
    for share in (True, False):
        model.zero_grad()
        outputs = _rollout(model, batch, state, share=share)
        sum(o.square().sum() for o in outputs).backward()
        results.append((outputs, [p.grad.clone() for p in model.parameters() if p.grad is not None]))
    for a, b in zip(results[0][0], results[1][0], strict=True):
        assert torch.equal(a, b)
    for a, b in zip(results[0][1], results[1][1], strict=True):
        assert torch.allclose(a, b, rtol=1e-3, atol=1e-5 * float(b.abs().max()))


def test_constants_serve_a_step_that_is_computed_once_more_in_the_backward_pass(
    make_scene, make_model, make_state
) -> None:
    scene = make_scene(70)
    model = make_model(scene, output_scale=0.5)
    batch, state = model.batch((0,)), make_state(scene)
    results = []
    for repeat in (False, True):
        model.zero_grad()
        prepared, now, before = model.prepare(batch), state.positions, state.previous

        def advance(x, y, prepared=prepared):
            return model.step(batch, SimState(x, y), None, prepared).positions

        for _ in range(3):
            following = checkpoint(advance, now, before, use_reentrant=False) if repeat else advance(now, before)
            now, before = following, now
        now.square().sum().backward()
        results.append([now, *(p.grad for p in model.parameters() if p.grad is not None)])
    assert len(results[0]) == len(results[1]) > 5
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_constants_of_another_batch_or_without_gradients_are_refused(make_scene, make_model, make_state) -> None:
    scene = make_scene(70)
    model, state = make_model([scene, scene]), make_state(scene)
    with pytest.raises(ValueError, match="another batch"):
        model.step(model.batch((0,)), state, None, model.prepare(model.batch((1,))))
    with torch.no_grad():
        prepared = model.prepare(model.batch((0,)))
        model.step(model.batch((0,)), state, None, prepared)
    with pytest.raises(ValueError, match="without gradients"):
        model.step(model.batch((0,)), state, None, prepared)


def test_a_rollout_repeats_bit_for_bit(make_scene, make_model, make_state) -> None:
    scene = make_scene(70)
    model = make_model(scene, output_scale=0.5)
    results = []
    for _ in range(2):
        model.zero_grad()
        outputs = _rollout(model, model.batch((0,)), make_state(scene), share=True)
        sum(o.square().sum() for o in outputs).backward()
        results.append([*outputs, *(p.grad for p in model.parameters() if p.grad is not None)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
