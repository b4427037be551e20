"""Edges of a step: their rules, and edges of a dummy node that keep shapes fixed."""

from __future__ import annotations

import pytest
import torch
from helpers.bodies import join_states, make_model, make_scene, make_state

from gausim.models.hierarchy.edges import exact_edges, fixed_edges
from gausim.ops.neighbours import radius_edges


def _levels(model, amount: float = 0.1):
    """The predicted levels of two sequences and the centres of mass of their units."""
    scene, batch = model.scenes[0], model.batch((0, 0))
    state = join_states([make_state(scene, seed=i, amount=amount) for i in range(2)])
    prepared = model.prepare(batch)
    return list(zip(batch.levels, prepared.per_level(prepared.finest(state.positions)), strict=True)), state


def _pairs(edges: torch.Tensor) -> set[tuple[int, int]]:
    return {(int(s), int(d)) for s, d in edges.T}


@pytest.mark.parametrize("rule", ["rest", "current", "union", "intersection"])
def test_rules_are_set_operations_within_members(rule) -> None:
    model = make_model(make_scene(90), graph_radii=(0.8, 0.25))
    radius = 0.25 * model.hierarchies[0].diagonal
    level, positions = _levels(model)[0][1]
    rest, current = set(), set()
    for span in level.spans:
        rest |= _pairs(radius_edges(model.hierarchies[0].levels[1].rest, radius, 6) + span.start)
        current |= _pairs(radius_edges(positions[span], radius, 6) + span.start)
    assert rest - current and current - rest and rest & current
    expected = {"rest": rest, "current": current, "union": rest | current, "intersection": rest & current}[rule]
    found = exact_edges(rule, level, positions)
    assert _pairs(found) == expected and found.shape[1] == len(expected)
    assert bool(((found[1] * level.count + found[0]).diff() > 0).all())


@pytest.mark.parametrize("rule", ["current", "union", "intersection"])
def test_fixed_edges_are_the_same_edges_and_dummies_behind_them(rule) -> None:
    model, counts = make_model(make_scene(90), graph_radii=(0.8, 0.25)), set()
    for amount in (0.02, 0.3):
        for level, positions in _levels(model, amount)[0]:
            exact, fixed = exact_edges(rule, level, positions), fixed_edges(rule, level, positions)
            assert torch.equal(fixed[:, : exact.shape[1]], exact)
            assert bool((fixed[:, exact.shape[1] :] == level.count).all())
            counts.add((level.count, fixed.shape[1]))
    assert len(counts) == 2  # one number of edges per level, whatever the positions


@pytest.mark.parametrize("coarse", [False, True])
def test_dummy_edges_change_nothing_for_real_units(coarse) -> None:
    scene = make_scene(90, dtype=torch.float64)
    results, seen = [], []
    for fixed in (False, True):
        model = make_model(scene, graph_radii=(0.8, 0.25), coarse_inputs=coarse, output_scale=3.0)
        if fixed:
            model.predictor._fixes_shapes = lambda positions: True  # as on CUDA in evaluation mode
        model.predictor.network.register_forward_pre_hook(lambda _, inputs: seen.append(len(inputs[0])))
        state = _levels(model, 0.05)[1]
        step = model.step(model.batch((0, 0)), state)
        sum(x.square().sum() for x in (step.positions, step.deformation_gradients, step.momentum)).backward()
        results.append([step.positions, step.deformation_gradients, *(p.grad for p in model.parameters())])
    for a, b in zip(*results, strict=True):
        assert torch.allclose(a, b, rtol=1e-9, atol=1e-12)
    assert seen[2:] == [n + 1 for n in seen[:2]]
    assert float((results[0][0].detach()[: scene.count] - scene.means).norm(dim=-1).max()) > 1e-3
