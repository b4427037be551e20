"""A network of its own for each predicted level."""

from __future__ import annotations

import pytest
import torch
from torch import nn


@pytest.mark.parametrize("level", [0, 1])
def test_each_level_is_predicted_by_its_own_network(make_scene, make_model, make_state, level) -> None:
    scene = make_scene(90)
    model = make_model(scene, share_network=False, output_scale=3.0)
    assert isinstance(model.predictor.network, nn.ModuleList) and len(model.predictor.network) == 2
    batch, state = model.batch((0,)), make_state(scene)
    before = model.step(batch, state).predicted
    with torch.no_grad():
        model.predictor.network[level].decoder[-1].bias.add_(0.5)
    after = model.step(batch, state).predicted
    if level == 0:  # the finer level sees the coarser one's result, so only the coarse one can stay
        assert not torch.allclose(before[0], after[0], atol=1e-3)
    else:
        assert torch.equal(before[0], after[0]) and not torch.allclose(before[1], after[1], atol=1e-3)
    model.predictor.network[1 - level].requires_grad_(False)
    after[level].square().sum().backward()
    assert all(p.grad is not None for p in model.predictor.network[level].parameters())
    assert {id(p) for p in model.predictor.network.parameters()} <= {id(p) for p in model.parameter_groups()["network"]}


def test_all_of_them_start_at_zero_output(make_scene, make_model, make_state) -> None:
    scene = make_scene(90)
    model = make_model(scene, share_network=False, zero_output=True)
    step = model.step(model.batch((0,)), make_state(scene))
    assert all(torch.equal(f, torch.eye(3).expand_as(f)) for f in step.predicted)
