"""The deformation field: rest at first, covariances as its scales and quaternions say, looping, a scene it learns."""

import torch
from helpers.fitted_methods import recorded, rolled

from gausim.baselines.deformation_field import DeformationField
from gausim.baselines.fitted import FittedDynamics
from gausim.core import SimState
from gausim.ops.covariance import covariance_from_scales, transport_covariance
from gausim.ops.rotation import quaternion_to_matrix


def made(seen: int = 4, **sizes: int) -> DeformationField:
    torch.manual_seed(0)
    sizes = {"resolution": 6, "features": 8, "hidden": 16, **sizes}
    return DeformationField(**recorded(seen=seen), **sizes)


def test_gradients_reproduce_the_deformed_covariance() -> None:
    field, generator = made(), torch.Generator().manual_seed(1)
    scene = field.scenes[0]
    with torch.no_grad():
        for own in (field.means[1], field.scales[1], field.rotations[1]):
            own.copy_(0.3 * torch.randn(own.shape, generator=generator))
        state = field.advance(field.begin(1))
    got = transport_covariance(covariance_from_scales(scene.log_scales, scene.quats), state.deformation_gradients)
    free = (scene.simulated & ~scene.pinned).float()[:, None]
    quats = torch.nn.functional.normalize(scene.quats, dim=-1) + free * field.rotations[1]
    expected = covariance_from_scales(scene.log_scales + free * field.scales[1], quats)
    torch.testing.assert_close(got, expected.detach(), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(torch.linalg.det(state.rotations), torch.ones(scene.count), rtol=1e-4, atol=0)
    assert torch.equal(state.positions[scene.pinned], scene.means[scene.pinned])


def test_beyond_the_trained_frames_it_repeats_them() -> None:
    field = made(seen=3)
    with torch.no_grad():
        for head in field.fields[0].heads:  # type: ignore[union-attr]
            head[-1].weight.normal_()
        for plane in field.fields[0].planes.planes:  # type: ignore[union-attr]
            plane.uniform_()
        rest = field.scenes[0].means
        trajectory = FittedDynamics(field, 0).rollout(SimState(rest, rest), 9)
    x = trajectory.positions
    assert not torch.allclose(x[1], x[2]) and not torch.allclose(x[0], x[3])
    for frame in range(10):
        torch.testing.assert_close(x[frame], x[frame % 4])


def test_it_learns_a_scene_that_moves_and_turns() -> None:
    field = made(seen=4)
    scene, frames = field.scenes[0], range(1, 5)
    free = (~scene.pinned).float()[:, None]
    wanted = []
    for frame in frames:
        angle = torch.tensor([1.0, 0, 0, 0.05 * frame])
        turn = quaternion_to_matrix(angle)
        wanted.append((scene.means + free * (scene.means @ turn.T - scene.means + 0.02 * frame), turn))
    groups = field.parameter_groups()
    rates = {"planes": 6.4e-3, "layers": 6.4e-4, "means": 1e-3, "scales": 5e-3, "rotations": 5e-3}
    optimizer = torch.optim.Adam([{"params": list(groups[n]), "lr": rate} for n, rate in rates.items()], eps=1e-15)

    def losses() -> list[torch.Tensor]:
        found = []
        for (x, turn), state in zip(wanted, rolled(field, 4)[1:], strict=True):
            by_turn = (state.deformation_gradients - turn).square() * free[:, None]
            found.append((state.positions - x).square().mean() + 0.1 * by_turn.mean())
        return found

    before = sum(float(loss.detach()) for loss in losses())
    for _ in range(150):
        optimizer.zero_grad()
        sum(losses()).backward()  # type: ignore[union-attr]
        optimizer.step()
    assert sum(float(loss.detach()) for loss in losses()) < 0.02 * before
    assert all(p.grad is None for p in field.fields[1].parameters())  # the other sequence is fitted by itself
