from __future__ import annotations

import pytest
import torch
from helpers.bodies import make_model, make_scene, make_state
from helpers.simulators import feed

from gausim.ops.covariance import kernel_volumes


def _feed(model, *, top: float, below: float) -> None:
    """Random gradients of these sizes instead of the network's; pinned units keep the identity."""
    generator = torch.Generator().manual_seed(0)

    def predict(level, unit, above, target, position):
        size = below if position else top
        noise = torch.randn(level.count, 3, 3, generator=generator, dtype=torch.float64)
        value = torch.eye(3) + size * noise * ~level.pinned[:, None, None]
        return value, value

    feed(model, predict)


@torch.no_grad()
def test_zero_where_children_have_no_gradients_of_their_own() -> None:
    scene = make_scene(90, dtype=torch.float64)
    model = make_model(scene)
    batch, state = model.batch((0,)), make_state(scene)
    values = []
    for top, below in ((0.0, 0.0), (0.4, 0.0), (0.0, 0.4), (0.4, 0.4)):
        _feed(model, top=top, below=below)
        values.append(float(model.step(batch, state).momentum))
    assert max(values[:2]) < 1e-20
    assert min(values[2:]) > 1e-6


@torch.no_grad()
def test_equals_the_double_sum_over_parents_and_children() -> None:
    scene = make_scene(90, dtype=torch.float64)
    model = make_model(scene, output_scale=5.0)
    step = model.step(model.batch((0,)), make_state(scene))
    hierarchy = model.hierarchies[0]
    fine, coarse = hierarchy.ancestor(0, 1), hierarchy.ancestor(0, 2)
    mass = model.log_density[0].exp() * kernel_volumes(scene.log_scales, scene.volume_scale)[scene.simulated]
    rest = scene.means[scene.simulated]

    def centre(members):
        return (mass[members, None] * rest[members]).sum(0) / mass[members].sum()

    total = 0.0
    for c, (root, held) in enumerate(zip(hierarchy.levels[2].root, hierarchy.levels[2].pinned, strict=True)):
        if held:
            continue
        parent_rest, gradient = centre(coarse == c), step.predicted[0][c]
        parent = rest[root] + gradient @ (parent_rest - rest[root])
        error = mass[coarse == c].sum() * parent
        for i in fine[coarse == c].unique():
            own = step.predicted[1][i] @ gradient
            error = error - mass[fine == i].sum() * (parent + own @ (centre(fine == i) - parent_rest))
        total += float((error / (mass.sum() * scene.diagonal)).square().sum())
    assert total > 1e-8
    assert float(step.momentum) == pytest.approx(total, rel=1e-9)


@torch.no_grad()
def test_off_switch_and_single_level_give_exactly_zero_and_the_same_motion() -> None:
    scene = make_scene(70)
    on, off = make_model(scene, output_scale=5.0), make_model(scene, output_scale=5.0, conserve_momentum=False)
    state = make_state(scene)
    a, b = on.step(on.batch((0,)), state), off.step(off.batch((0,)), state)
    assert float(a.momentum) > 0 and float(b.momentum) == 0
    assert torch.equal(a.positions, b.positions)
    flat = make_model(scene, predicted_levels=(0,), graph_radii=(0.3,), output_scale=5.0)
    assert float(flat.step(flat.batch((0,)), state).momentum) == 0
