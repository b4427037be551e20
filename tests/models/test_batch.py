"""Hierarchies, unions of scenes as one graph, and edges: their rules, and dummies that keep shapes fixed."""

from functools import partial

import pytest
import torch
from helpers.bodies import NEURAL, join_states, make_model, make_scene, make_state

from gausim.models.hierarchy.batch import exact_edges, fixed_edges
from gausim.models.hierarchy.clusters import build_hierarchy
from gausim.models.template.material import MaterialTemplate
from gausim.ops.covariance import kernel_volumes
from gausim.ops.neighbours import radius_edges

PAPER = {"output_scale": 2.0}
CASES = {
    "hierarchy": PAPER, "kernels under the top": PAPER | {"predicted_levels": (2, 0), "graph_radii": (0.8, 0.3)},
    "elastic": PAPER | {"template": partial(MaterialTemplate, modes=5)}, "neural": NEURAL,
}  # fmt: skip


@pytest.mark.parametrize("options", CASES.values(), ids=CASES)
@torch.no_grad()
def test_union_of_scenes_and_sequences_equals_each_alone(options) -> None:
    scenes = [make_scene(70, dtype=torch.float64), make_scene(55, seed=1, dtype=torch.float64)]
    model = make_model(scenes, **options)
    ids = (0, 1, 0)
    states = [make_state(scenes[s], seed=i) for i, s in enumerate(ids)]
    draws = [torch.Generator().manual_seed(i) for i in range(3)]
    forces = [torch.randn(scenes[s].count, 3, generator=g).double() for s, g in zip(ids, draws, strict=True)]
    batch = model.batch(ids)
    assert batch.scene_ids == ids and [m.scene_id for m in batch.members] == [0, 1, 0]
    joint = model.step(batch, join_states(states), torch.cat(forces))
    momentum = 0.0
    for member, scene_id, state, force in zip(batch.members, ids, states, forces, strict=True):
        alone = model.step(model.batch((scene_id,)), state, force)
        assert torch.allclose(joint.positions[member.kernels], alone.positions, atol=1e-6)
        assert torch.allclose(joint.deformation_gradients[member.units], alone.deformation_gradients, atol=1e-5)
        assert torch.allclose(joint.rotations[member.units], alone.rotations, atol=1e-5)
        assert torch.equal(member.unit_of_kernel, model.batch((scene_id,)).members[0].unit_of_kernel)
        momentum += float(alone.momentum)
        assert float((alone.positions - scenes[scene_id].means).abs().max()) > 1e-3
    assert float(joint.momentum) == pytest.approx(momentum, rel=1e-4)
    first, _, third = (joint.positions[m.kernels] for m in batch.members)
    assert float((first - third).abs().max()) > 1e-4  # two sequences of one scene keep their own states


@pytest.mark.parametrize(("predicted", "graph"), [((2, 1), (0.8, 0.35)), ((0,), (0.3,))])
@torch.no_grad()
def test_kernels_follow_their_unit_and_held_ones_the_identity(predicted, graph) -> None:
    scene = make_scene(70)
    model = make_model(scene, predicted_levels=predicted, graph_radii=graph, output_scale=3.0)
    batch = model.batch((0,))
    member, hierarchy = batch.members[0], model.hierarchies[0]
    step = model.step(batch, make_state(scene))
    held = scene.pinned | ~scene.simulated
    last = member.units.stop - 1
    assert all(torch.equal(x[last], torch.eye(3)) for x in (step.deformation_gradients, step.rotations))
    assert bool((member.unit_of_kernel[held] == last).all()) and not bool((member.unit_of_kernel[~held] == last).any())
    finest = hierarchy.ancestor(0, model.predicted_levels[-1])
    free = ~hierarchy.levels[0].pinned
    assert torch.equal(member.unit_of_kernel[hierarchy.kernels[free]], finest[free])
    assert len(step.predicted) == len(predicted)
    assert [len(f) for f in step.predicted] == [hierarchy.levels[n].count for n in model.predicted_levels]


def _levels(model, amount: float = 0.1):
    """The predicted levels of two sequences and the centres of mass of their units."""
    scene, batch = model.scenes[0], model.batch((0, 0))
    state = join_states([make_state(scene, seed=i, amount=amount) for i in range(2)])
    prepared = model.prepare(batch)
    return list(zip(batch.levels, prepared.per_level(prepared.finest(state.positions)), strict=True)), state


def _pairs(edges: torch.Tensor) -> set[tuple[int, int]]:
    return {(int(s), int(d)) for s, d in edges.T}


@pytest.mark.parametrize("rule", ["rest", "union", "intersection"])
def test_rules_are_set_operations_within_members(rule) -> None:
    model = make_model(make_scene(90), graph_radii=(0.8, 0.25))
    radius = 0.25 * model.hierarchies[0].diagonal
    level, positions = _levels(model)[0][1]
    rest, current = set(), set()
    for span in level.spans:
        rest |= _pairs(radius_edges(model.hierarchies[0].levels[1].rest, radius, 6) + span.start)
        current |= _pairs(radius_edges(positions[span], radius, 6) + span.start)
    assert rest - current and current - rest and rest & current
    expected = {"rest": rest, "union": rest | current, "intersection": rest & current}[rule]
    found = exact_edges(rule, level, positions)
    assert _pairs(found) == expected and found.shape[1] == len(expected)
    assert bool(((found[1] * level.count + found[0]).diff() > 0).all())


@pytest.mark.parametrize("rule", ["union", "intersection"])
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


RADII = (0.15, 0.35, 0.7)


def test_every_unit_has_one_parent_of_its_own_kind_and_volumes_add_up() -> None:
    scene = make_scene(120, dtype=torch.float64)
    hierarchy = build_hierarchy(scene, radii=RADII)
    counts = [level.count for level in hierarchy.levels]
    assert counts[0] == int(scene.simulated.sum()) and counts == sorted(set(counts), reverse=True)
    volume = kernel_volumes(scene.log_scales, scene.volume_scale)[scene.simulated]
    for fine, coarse in zip(hierarchy.levels[:-1], hierarchy.levels[1:], strict=True):
        assert fine.parent.shape == (fine.count,)
        assert set(fine.parent.tolist()) == set(range(coarse.count))  # each has a parent, no parent is empty
        assert torch.equal(coarse.pinned[fine.parent], fine.pinned)  # a cluster never mixes pinned and free
        summed = coarse.volume.new_zeros(coarse.count).index_add(0, fine.parent, fine.volume)
        assert torch.allclose(coarse.volume, summed)
        assert torch.allclose(coarse.volume.sum(), volume.sum(), rtol=1e-12)
    assert len(hierarchy.levels[-1].parent) == 0
    assert 0 < int(hierarchy.levels[-1].pinned.sum()) < hierarchy.levels[-1].count


@pytest.mark.parametrize("predicted", [[3, 2, 1], [0]])
def test_masses_add_up_level_by_level_with_random_densities(predicted) -> None:
    scenes = [make_scene(90, dtype=torch.float64), make_scene(60, seed=1, dtype=torch.float64)]
    model = make_model(scenes, radii=RADII, predicted_levels=predicted, graph_radii=[0.6] * len(predicted))
    batch = model.batch((0, 1, 0))
    mass, log_density = model.masses(batch)
    assert float(log_density.detach().std()) > 0.1
    assert torch.allclose(mass, batch.volume * log_density.exp())
    positions = batch.rest + torch.randn(batch.rest.shape, generator=torch.Generator().manual_seed(2)).to(batch.rest)
    prepared = model.prepare(batch)
    for level, unit, centre in zip(
        batch.levels, prepared.levels, prepared.per_level(prepared.finest(positions)), strict=True
    ):
        assert torch.allclose(unit.mass.sum(), mass.sum(), rtol=1e-12)
        assert torch.allclose(level.volume.sum(), batch.volume.sum(), rtol=1e-12)
        for c in range(level.count):
            members = level.unit_of_kernel == c
            assert torch.allclose(unit.mass[c], mass[members].sum())
            assert torch.allclose(unit.log_density[c].exp(), mass[members].sum() / batch.volume[members].sum())
            for found, values in ((centre, positions), (unit.rest, batch.rest)):
                weighted = (mass[:, None] * values[batch.simulated])[members].sum(0) / mass[members].sum()
                assert torch.allclose(found[c], weighted)


def test_centres_are_volume_weighted_and_roots_the_nearest_pinned_kernel() -> None:
    scene = make_scene(90, dtype=torch.float64)
    hierarchy = build_hierarchy(scene, radii=RADII)
    base = hierarchy.levels[0]
    assert torch.equal(base.rest, scene.means[hierarchy.kernels])
    for number in range(4):
        ancestor, level = hierarchy.ancestor(0, number), hierarchy.levels[number]
        for c in range(level.count):
            members = ancestor == c
            weight = base.volume[members, None]
            assert torch.allclose(level.rest[c], (weight * base.rest[members]).sum(0) / weight.sum())
    assert torch.equal(hierarchy.ancestor(1, 3)[hierarchy.ancestor(0, 1)], hierarchy.ancestor(0, 3))
    free = [int((~level.pinned).sum()) for level in hierarchy.levels]
    assert hierarchy.predictions([2, 1]) == free[2] + free[1]
    for level in hierarchy.levels:
        for c in range(level.count):
            distance = (base.rest - level.rest[c]).norm(dim=-1).masked_fill(~base.pinned, float("inf"))
            assert int(level.root[c]) == int(distance.argmin())
