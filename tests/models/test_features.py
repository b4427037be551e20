import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch

from gausim.models.step.features import FLOOR_FEATURES, FeatureOptions, edge_features, network_inputs
from gausim.models.step.recursion import Solved, Units

DT = 0.25
PAPER = FeatureOptions(rest_inputs=False, velocities=True, centred=False, floor=False)


class UnitState(NamedTuple):
    rest: torch.Tensor
    now: torch.Tensor
    before: torch.Tensor
    after: torch.Tensor


def _unit_state(seed: int, count: int = 4) -> UnitState:
    generator = torch.Generator().manual_seed(seed)
    return UnitState(*torch.randn(4, count, 3, generator=generator, dtype=torch.float64))


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return math.acos(float(a @ b) / float(np.linalg.norm(a) * np.linalg.norm(b)))


@pytest.mark.parametrize(("options", "coarse"), [
    (PAPER, False),
    (PAPER, True),
    (replace(PAPER, rest_inputs=True), False),
    (replace(PAPER, rest_inputs=True, velocities=False), False),
    (replace(PAPER, floor=True), False),
])  # fmt: skip
def test_node_features_by_hand(options: FeatureOptions, coarse: bool) -> None:
    size, index = 2.0, torch.tensor([1, 0, 1, 1])
    unit, parent, template = _unit_state(0), _unit_state(1, 2), _unit_state(2)
    gradient = torch.eye(3) + 0.3 * torch.randn(2, 3, 3, dtype=torch.float64)
    density, attributes = torch.linspace(-1, 1, 4).double(), torch.rand(4, 2).double()
    floor = torch.rand(4, FLOOR_FEATURES).double()
    units = Units(unit.rest, unit.now, unit.before, density.exp(), density, attributes, floor)
    above = Solved(*parent, template.rest[:2], gradient, gradient, index)
    constants = torch.full((4, 1), size).double(), torch.full((4, 1), DT).double()
    edges = torch.zeros(2, 0, dtype=torch.int64)
    out, _ = network_inputs(units, template.now, above, edges, *constants, options, coarse=coarse)
    for i, p in enumerate(index.tolist()):
        target, rest, now, before = (x[i].numpy() for x in (template.now, unit.rest, unit.now, unit.before))
        p_rest, p_now, p_before, p_after = (x[p].numpy() for x in parent)
        after = p_after + gradient[p].numpy() @ (target - template.rest[p].numpy())
        inertial = -(p_after - 2 * p_now + p_before) / DT**2
        local = after - p_after if coarse else now - p_now
        expected = [inertial, (local - (before - p_before)) / DT]
        if not options.velocities:
            expected = [rest - p_rest, now - rest, after - target]
        elif options.rest_inputs:
            expected += [now - rest, (after - now) / DT]
        columns = [np.concatenate(expected) / size, density[i : i + 1].numpy(), attributes[i].numpy()]
        columns += [floor[i].numpy()] if options.floor else []
        np.testing.assert_allclose(out[i].numpy(), np.concatenate(columns), rtol=1e-9)
    assert out.shape[1] == options.node_size - options.attributes + 2


@pytest.mark.parametrize("coarse", [False, True])
def test_edge_features_by_hand(coarse: bool) -> None:
    unit, centre = _unit_state(0), _unit_state(1)
    edge_index = torch.tensor([[1, 2, 0, 3], [0, 0, 1, 2]])
    options = replace(PAPER, rest_inputs=True)
    dt = torch.full((4, 1), DT, dtype=torch.float64)
    out = edge_features(torch.stack(unit), torch.stack(centre), edge_index, dt, options, coarse=coarse)
    current, about = (unit.after, centre.after) if coarse else (unit.now, centre.now)
    for e, (s, d) in enumerate(edge_index.T.tolist()):
        x, c = current.numpy(), about.numpy()[d]
        rest, rest_c, before = unit.rest.numpy(), centre.rest.numpy()[d], unit.before.numpy()
        now, length = x[d] - x[s], np.linalg.norm(x[d] - x[s])
        offset = rest[d] - rest[s]
        expected = [[length / np.linalg.norm(offset)], now / length, (now - (before[d] - before[s])) / DT]
        expected += [offset, now - offset]
        turn = _angle(x[d] - c, x[s] - c) - _angle(rest[d] - rest_c, rest[s] - rest_c)
        expected.append([math.cos(turn), math.sin(turn)])
        np.testing.assert_allclose(out[e].numpy(), np.concatenate(expected), rtol=1e-6, atol=1e-9)
    assert out.shape[1] == options.edge_size


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_geometry_gives_finite_bounded_features_and_gradients(dtype: torch.dtype) -> None:
    # Units 0 and 1 coincide at rest and now, 2 stands on its barycentre as an only child, 3 is in line with 0 and 1.
    rest = torch.tensor([[0.3, 0, 0], [0.3, 0, 0], [0.1, 0.2, 0], [0.6, 0, 0]], dtype=dtype)
    centre = torch.tensor([[0.0, 0, 0], [0.0, 0, 0], [0.1, 0.2, 0], [0.0, 0, 0]], dtype=dtype)
    unit, about = rest.clone().requires_grad_(), centre.clone().requires_grad_()
    edge_index = torch.tensor([[1, 0, 3, 2, 2, 3], [0, 1, 2, 3, 0, 0]])
    out = edge_features(
        torch.stack((rest, unit, unit, unit)), torch.stack((centre, about, about, about)), edge_index,
        torch.full((4, 1), DT, dtype=dtype), PAPER,
    )  # fmt: skip
    assert bool(torch.isfinite(out).all())
    assert float(out.detach()[:, 7:].abs().max()) <= 1 + 1e-6  # angles stay angles: they are not normalised later
    for column in range(out.shape[1]):
        for gradient in torch.autograd.grad(out[:, column].sum(), (unit, about), retain_graph=True):
            assert bool(torch.isfinite(gradient).all())
