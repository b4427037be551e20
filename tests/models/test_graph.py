"""Edges of a step: their rules, and edges of a dummy node that keep shapes fixed."""

from __future__ import annotations

import pytest
import torch

from gausim.core import ConfigError
from gausim.models.hierarchy.edges import EdgeSet
from gausim.ops.neighbours import radius_edges


def units_of(model, batch, state) -> list[torch.Tensor]:
    """Centres of mass of every predicted level."""
    prepared = model.prepare(batch)
    return prepared.per_level(prepared.finest(state.positions))


def _pairs(edges: torch.Tensor) -> set[tuple[int, int]]:
    return {(int(s), int(d)) for s, d in edges.T}


def _moved(scene, model, make_state, join_states, amount: float = 0.1):
    batch = model.batch((0, 0))
    states = [make_state(scene, seed=i, amount=amount) for i in range(2)]
    return batch, join_states(states)


@pytest.mark.parametrize("rule", ["rest", "current", "union", "intersection"])
def test_rules_are_set_operations_within_members(make_scene, make_model, make_state, join_states, rule) -> None:
    scene = make_scene(90)
    model = make_model(scene, graph_radii=(0.8, 0.25))
    batch, state = _moved(scene, model, make_state, join_states)
    units = units_of(model, batch, state)
    radii = [fraction * model.hierarchies[0].diagonal for fraction in (0.8, 0.25)]
    rest, current = set(), set()
    level, positions = batch.levels[1], units[1]
    for span in level.spans:
        still = radius_edges(model.hierarchies[0].levels[1].rest, radii[1], 6) + span.start
        rest |= _pairs(still)
        current |= _pairs(radius_edges(positions[span], radii[1], 6) + span.start)
    assert rest - current and current - rest and rest & current
    expected = {"rest": rest, "current": current, "union": rest | current, "intersection": rest & current}[rule]
    found = EdgeSet(rule).of(level, positions)
    assert _pairs(found) == expected and found.shape[1] == len(expected)
    order = found[1] * level.count + found[0]
    assert bool((order.diff() > 0).all())


@pytest.mark.parametrize("rule", ["current", "union", "intersection"])
def test_fixed_edges_are_the_same_edges_and_dummies_behind_them(
    make_scene, make_model, make_state, join_states, rule
) -> None:
    scene = make_scene(90)
    model, edges = make_model(scene, graph_radii=(0.8, 0.25)), EdgeSet(rule)
    counts = set()
    for amount in (0.02, 0.3):
        batch, state = _moved(scene, model, make_state, join_states, amount)
        for level, positions in zip(batch.levels, units_of(model, batch, state), strict=True):
            exact, fixed = edges.of(level, positions), edges.fixed(level, positions)
            assert torch.equal(fixed[:, : exact.shape[1]], exact)
            assert bool((fixed[:, exact.shape[1] :] == level.count).all())
            counts.add((level.count, fixed.shape[1]))
    assert len(counts) == 2  # one number of edges per level, whatever the positions


@pytest.mark.parametrize("coarse", [False, True])
def test_dummy_edges_change_nothing_for_real_units(make_scene, make_model, make_state, join_states, coarse) -> None:
    scene = make_scene(90, dtype=torch.float64)
    models = [
        make_model(scene, graph_radii=(0.8, 0.25), coarse_inputs=coarse, output_scale=3.0) for _ in range(2)
    ]  # fmt: skip
    models[1].predictor._fixes_shapes = lambda positions: True  # as on CUDA in evaluation mode
    seen: list[tuple[int, int]] = []
    for model in models:
        model.predictor.network.register_forward_pre_hook(
            lambda _, inputs: seen.append((len(inputs[0]), inputs[2].shape[1]))
        )
    results = []
    for model in models:
        batch, state = _moved(scene, model, make_state, join_states, 0.05)
        state.previous.requires_grad_()
        model.zero_grad()
        step = model.step(batch, state)
        sum(x.square().sum() for x in (step.positions, step.deformation_gradients, step.momentum)).backward()
        results.append(
            [step.positions, step.deformation_gradients, *(p.grad for p in model.parameters() if p.grad is not None)]
        )
    for a, b in zip(*results, strict=True):
        assert torch.allclose(a, b, rtol=1e-9, atol=1e-12)
    (top, fine), fixed = seen[:2], seen[2:]
    assert [n for n, _ in fixed] == [top[0] + 1, fine[0] + 1]
    assert fixed[1][1] == 12 * fine[0] > fine[1]  # six neighbours at rest and six now of every unit
    assert float((results[0][0].detach()[: scene.count] - scene.means).norm(dim=-1).max()) > 1e-3


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="edges is 'nearest'; expected one of rest, current, union, intersection"):
        EdgeSet("nearest")
