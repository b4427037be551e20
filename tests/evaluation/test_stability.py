"""The largest eigenvalue of the linearised step: the template's own matrices, growth of a small motion."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from helpers import toy_object
from helpers.simulators import gausim

import gausim.evaluation.stability as stability
from gausim.core import SimState
from gausim.models.step.simulator import GausSim
from gausim.models.template.elastic import ElasticTemplate


def _model(**options: object) -> GausSim:
    torch.manual_seed(0)
    template = partial(ElasticTemplate, modes=9, neighbours=6)
    settings = {"radii": (0.3, 0.7), "hidden": 8, "layers": 1, "edges": "rest", "template": template}
    return gausim([toy_object.toy_scene()], [24.0], **(settings | options))


def test_without_a_network_it_is_that_of_the_template_s_matrices() -> None:
    model = _model(zero_output=True)
    with torch.no_grad():
        model.template.scenes[0].damping.fill_(-0.5)
        part = model.modal_scene(0)
        inertia, stiffness, damping = part.inertia, part.stiffness, part.damping
    inverse = torch.linalg.inv(inertia + stiffness / 4 + damping / 2)
    now, before = inverse @ (2 * inertia - stiffness / 2), inverse @ (inertia + stiffness / 4 - damping / 2)
    step = torch.cat((torch.cat((now, -before), 1), torch.eye(9, 18)))
    expected = float(torch.linalg.eigvals(step).abs().max())
    assert expected < 0.9999
    assert stability.largest_eigenvalue(model, 0) == pytest.approx(expected, abs=1e-4)


def test_it_is_the_growth_of_a_small_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    model = _model(output_scale=0.3, anchor=True).train()
    batch = model.batch([0])
    with torch.no_grad():
        model.step(batch, SimState(batch.rest, batch.rest))  # gathers statistics of the inputs
    found = stability.largest_eigenvalue(model, 0)
    assert model.training
    monkeypatch.setattr(stability, "DENSE", 0)
    assert stability.largest_eigenvalue(model, 0) == pytest.approx(found, abs=1e-4)
    model.eval()
    draw = torch.randn(batch.rest.shape, generator=torch.Generator().manual_seed(0))
    state = SimState(batch.rest, batch.rest + 1e-4 * draw)
    logs, small, prepared = [], 1e-4, model.prepare(batch)
    with torch.no_grad():
        for _ in range(300):
            after = model.step(batch, state, prepared=prepared).positions
            factor = small / float(torch.stack((after - batch.rest, state.positions - batch.rest)).abs().max())
            state = SimState(
                batch.rest + factor * (after - batch.rest), batch.rest + factor * (state.positions - batch.rest)
            )
            logs.append(-torch.tensor(factor).log())
    # The motion turns as it grows, so a mean with equal weights depends on where in a turn it begins and ends.
    weights = torch.hann_window(240, periodic=False)
    mean = (torch.stack(logs[60:]) * weights).sum() / weights.sum()
    assert float(mean.exp()) == pytest.approx(found, abs=5e-3)
