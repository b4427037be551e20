"""The recursion against METHOD section 2's closed sum, the momentum loss, and deformations that move a lever."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from helpers.bodies import make_model, make_scene, make_state
from helpers.simulators import feed
from torch import Tensor

from gausim.models.step.features import FLOOR_FEATURES, FeatureOptions, edge_features, network_inputs
from gausim.models.step.head import SHORT, lever_deformation
from gausim.models.step.recursion import Solved, Units
from gausim.ops.covariance import kernel_volumes
from gausim.ops.rotation import quaternion_to_matrix


def test_positions_equal_the_corrected_sum_over_three_levels() -> None:
    scene = make_scene(120, dtype=torch.float64)
    levels, fractions = (3, 2, 1), (0.15, 0.35, 0.7)
    model = make_model(scene, radii=fractions, predicted_levels=levels, graph_radii=(0.9, 0.6, 0.3))
    own: dict[int, Tensor] = {}
    turns: dict[int, Tensor] = {}
    order = iter(levels)

    def random_gradients(level, unit, above, target, position):
        number = next(order)
        generator = torch.Generator().manual_seed(number)
        own[number] = torch.eye(3) + 0.4 * torch.randn(level.count, 3, 3, generator=generator, dtype=torch.float64)
        turns[number] = quaternion_to_matrix(torch.randn(level.count, 4, generator=generator, dtype=torch.float64))
        return own[number], turns[number]

    feed(model, random_gradients)
    with torch.no_grad():
        step = model.step(model.batch((0,)), make_state(scene))

    hierarchy = model.hierarchies[0]
    rest = scene.means[scene.simulated]
    volume = kernel_volumes(scene.log_scales, scene.volume_scale)[scene.simulated]
    mass = (model.log_density[0].exp() * volume).detach()
    chains = torch.stack([hierarchy.ancestor(0, n) for n in range(4)])
    centre = {
        n: torch.stack(
            [
                (mass[chains[n] == c, None] * rest[chains[n] == c]).sum(0) / mass[chains[n] == c].sum()
                for c in range(hierarchy.levels[n].count)
            ]
        )
        for n in (1, 2, 3)
    }
    pinned = scene.pinned[scene.simulated]
    checked = 0
    for k in range(len(rest)):
        expected = rest[k]
        if not pinned[k]:
            # c_h of the paper is our level h + 1 unit, c_L the root; x_{c_0} first, then the kernel about it.
            points = [centre[n][chains[n, k]] for n in (1, 2, 3)] + [rest[hierarchy.levels[3].root[chains[3, k]]]]
            factors = {j: own[j][chains[j, k]] for j in (1, 2, 3)}
            expected = points[3].clone()
            for i in range(3):
                product = torch.eye(3, dtype=torch.float64)
                for j in range(i + 1, 4):  # finest leftmost
                    product = product @ factors[j]
                expected = expected + product @ (points[i] - points[i + 1])
            gradient = factors[1] @ factors[2] @ factors[3]
            expected = expected + gradient @ (rest[k] - points[0])
            assert torch.allclose(step.deformation_gradients[chains[1, k]], gradient, atol=1e-12)
            rotation = turns[1][chains[1, k]] @ turns[2][chains[2, k]] @ turns[3][chains[3, k]]
            assert torch.allclose(step.rotations[chains[1, k]], rotation, atol=1e-12)
            checked += 1
        assert torch.allclose(step.positions[hierarchy.kernels[k]], expected, atol=1e-12)
    assert checked > 60 and torch.equal(step.positions[~scene.simulated], scene.means[~scene.simulated])


def _random_feed(model, *, top: float, below: float) -> None:
    """Random gradients of these sizes instead of the network's; pinned units keep the identity."""
    generator = torch.Generator().manual_seed(0)

    def predict(level, unit, above, target, position):
        size = below if position else top
        noise = torch.randn(level.count, 3, 3, generator=generator, dtype=torch.float64)
        value = torch.eye(3) + size * noise * ~level.pinned[:, None, None]
        return value, value

    feed(model, predict)


@torch.no_grad()
def test_momentum_equals_the_double_sum_and_is_zero_without_own_gradients() -> None:
    scene = make_scene(90, dtype=torch.float64)
    model = make_model(scene)
    batch, state = model.batch((0,)), make_state(scene)
    values = []
    for top, below in ((0.0, 0.0), (0.4, 0.0), (0.0, 0.4), (0.4, 0.4)):
        _random_feed(model, top=top, below=below)
        values.append(float(model.step(batch, state).momentum))
    assert max(values[:2]) < 1e-20
    assert min(values[2:]) > 1e-6
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


def test_levers_move_by_the_shift_and_keep_volume() -> None:
    generator = torch.Generator().manual_seed(0)
    lever = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    shift = 0.1 * torch.randn(20, 3, generator=generator, dtype=torch.float64)
    length = torch.full((20, 1), 1e-3, dtype=torch.float64)  # every lever is long
    made = lever_deformation(shift, lever, length, conserve_mass=True)
    moved = (made @ lever[..., None])[..., 0]
    torch.testing.assert_close(moved, lever + shift, atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(made), torch.ones(20, dtype=torch.float64), atol=1e-6, rtol=0)
    free = lever_deformation(shift, lever, length, conserve_mass=False)
    torch.testing.assert_close((free @ lever[..., None])[..., 0], moved, atol=1e-6, rtol=0)
    assert float((torch.linalg.det(free) - 1).abs().max()) > 1e-2
    lever = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [SHORT, 0.0, 0.0]], dtype=torch.float64)
    length = torch.ones(3, 1, dtype=torch.float64)
    still = lever_deformation(torch.zeros_like(lever), lever, length, conserve_mass=True)
    torch.testing.assert_close(still, torch.eye(3, dtype=torch.float64).expand(3, 3, 3), atol=1e-12, rtol=0)
    shift = torch.full_like(lever, 0.01)
    made = lever_deformation(shift, lever, length, conserve_mass=True)
    assert torch.isfinite(made).all()
    torch.testing.assert_close(made[1], torch.eye(3, dtype=torch.float64))
    half = (made[2] @ lever[2]) - lever[2]  # at the length SHORT half of the shift is made
    torch.testing.assert_close(half, 0.5 * shift[2], rtol=1e-3, atol=0)


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
