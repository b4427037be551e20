"""The recursion against METHOD section 2's closed sum, and its behaviour under rotations."""

from __future__ import annotations

from dataclasses import replace

import torch
from helpers.simulators import feed
from torch import Tensor

from gausim.core import SimState
from gausim.ops.covariance import covariance_from_scales, kernel_volumes, transport_covariance
from gausim.ops.deformation import gradient_from_output
from gausim.ops.quaternion import quaternion_to_matrix
from gausim.ops.spherical_harmonics import evaluate_sh


def test_positions_equal_the_corrected_sum_over_three_levels(make_scene, make_model, make_state) -> None:
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


def _multiply(p: Tensor, q: Tensor) -> Tensor:
    vector = p[0] * q[:, 1:] + q[:, :1] * p[1:] + torch.linalg.cross(p[1:].expand(len(q), 3), q[:, 1:])
    return torch.cat((p[0] * q[:, :1] - (q[:, 1:] @ p[1:])[:, None], vector), 1)


def _field(rest: Tensor, number: int) -> Tensor:
    """Eleven outputs that vary smoothly over the body, different on each level."""
    generator = torch.Generator().manual_seed(number)
    weight = 3 * torch.randn(3, 11, generator=generator, dtype=torch.float64)
    return 0.6 * torch.sin(rest @ weight + number)


def test_rotating_the_scene_and_the_gradients_rotates_everything(make_scene, make_model, make_state) -> None:
    scene, state = make_scene(90, dtype=torch.float64), make_state(make_scene(90, dtype=torch.float64))
    quat = torch.tensor([0.8, -0.3, 0.5, 0.4], dtype=torch.float64)
    quat = quat / quat.norm()
    r = quaternion_to_matrix(quat[None])[0]
    turned = replace(scene, means=scene.means @ r.T, quats=_multiply(quat, scene.quats))
    results = []
    for current, rotation in ((scene, torch.eye(3, dtype=torch.float64)), (turned, r)):
        # Radii are fractions of the box, which turning changes; complete linkage sees distances only.
        radii = tuple(f * scene.diagonal / current.diagonal for f in (0.2, 0.5))
        model = make_model(current, radii=radii, clustering="complete_linkage")
        calls = iter((0, 1))

        def fed(level, unit, above, target, position, rotation=rotation, calls=calls):
            output = torch.where(level.pinned[:, None], 0.0, _field(unit.rest @ rotation, next(calls)))
            gradient, turn = gradient_from_output(output, conserve_mass=False)
            return rotation @ gradient @ rotation.T, rotation @ turn @ rotation.T

        feed(model, fed)
        moved = SimState(state.positions @ rotation.T, state.previous @ rotation.T)
        with torch.no_grad():
            step = model.step(model.batch((0,)), moved)
        unit = model.batch((0,)).members[0].unit_of_kernel
        results.append((step, step.deformation_gradients[unit], step.rotations[unit], current))
    (step, gradient, rotation, _), (other, other_gradient, other_rotation, _) = results
    assert float((step.positions - scene.means).norm(dim=-1).max()) > 0.05
    assert torch.allclose(other.positions, step.positions @ r.T, atol=1e-12)
    free = scene.simulated & ~scene.pinned  # the others keep the identity in both
    assert torch.allclose(other_gradient[free], (r @ gradient @ r.T)[free], atol=1e-12)
    assert torch.allclose(other_rotation[free], (r @ rotation @ r.T)[free], atol=1e-12)

    covars = transport_covariance(covariance_from_scales(scene.log_scales, scene.quats), gradient)
    other_covars = transport_covariance(covariance_from_scales(turned.log_scales, turned.quats), other_gradient)
    assert torch.allclose(other_covars, r @ covars @ r.T, atol=1e-12)

    directions = torch.nn.functional.normalize(step.positions - torch.tensor([3.0, -2.0, 1.0]), dim=-1)
    # In the turned scene the same coefficients are read in the turned frame: looking along R d gives R (Q^T d).
    read = (rotation.mT @ directions[..., None])[..., 0]
    other_read = (other_rotation.mT @ (directions @ r.T)[..., None])[..., 0]
    assert torch.allclose(other_read, read @ r.T, atol=1e-12)
    assert torch.allclose(evaluate_sh(scene.sh, other_read @ r), evaluate_sh(scene.sh, read), atol=1e-12)
    assert float((read - directions).abs()[free].max()) > 0.1


def test_turning_everything_about_the_root_carries_the_whole_body(make_scene, make_model, make_state) -> None:
    """One rotation at the top and identities below is a rigid turn of each top unit about its root."""
    scene = make_scene(90, dtype=torch.float64)
    model = make_model(scene)
    r = quaternion_to_matrix(torch.tensor([[0.9, 0.1, -0.4, 0.2]], dtype=torch.float64))[0]

    def turn_the_top(level, unit, above, target, position):
        value = (r if position == 0 else torch.eye(3, dtype=torch.float64)).expand(level.count, 3, 3)
        return value, value

    feed(model, turn_the_top)
    with torch.no_grad():
        step = model.step(model.batch((0,)), make_state(scene))
    hierarchy = model.hierarchies[0]
    rest = scene.means[hierarchy.kernels]
    root = rest[hierarchy.levels[2].root[hierarchy.ancestor(0, 2)]]
    expected = torch.where(scene.pinned[hierarchy.kernels, None], rest, root + (rest - root) @ r.T)
    assert torch.allclose(step.positions[hierarchy.kernels], expected, atol=1e-12)
