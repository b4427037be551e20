"""The recursion against METHOD section 2's closed sum, the momentum loss, and deformations that move a lever."""

import pytest
import torch
from helpers.bodies import make_model, make_scene, make_state
from helpers.simulators import feed
from torch import Tensor

from gausim.models.step.head import SHORT, lever_deformation
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
