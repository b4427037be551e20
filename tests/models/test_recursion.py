"""The recursion against METHOD section 2's closed sum."""

from __future__ import annotations

import torch
from helpers.bodies import make_model, make_scene, make_state
from helpers.simulators import feed
from torch import Tensor

from gausim.ops.covariance import kernel_volumes
from gausim.ops.quaternion import quaternion_to_matrix


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
