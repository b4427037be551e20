"""The deformation field: rest at first, covariances as its scales and quaternions say, looping, a scene it learns."""

from collections.abc import Callable

import pytest
import torch
from helpers.fitted_methods import recorded, rolled

from gausim.baselines.deformation_field import DeformationField
from gausim.baselines.fitted import FittedDynamics
from gausim.baselines.stages import FitPlan, Stage
from gausim.core import ConfigError, SimState
from gausim.losses.mixed import MixedLoss
from gausim.nn.schedules import ExponentialSchedule, HalvingSchedule, LinearSchedule
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


def stage(iterations: int = 10, **options: object) -> Stage:
    return Stage(iterations, {"a": 0.1}, MixedLoss(l1=1.0), **options)  # type: ignore[arg-type]


def test_epochs_walk_through_stages_with_their_windows_and_rates() -> None:
    plan = FitPlan({"first": stage(10), "left": None, "second": stage(20)}, round=5)
    assert plan.shows == 5 and plan.epochs == 6
    places = [(name, done) for name, _, done in (plan.place(e) for e in (0, 1, 1.5, 2, 5, 6, 7))]
    assert places == [("first", 0), ("first", 5), ("first", 7.5), ("second", 0), ("second", 15),
                      ("second", 20), ("second", 20)]  # fmt: skip
    assert FitPlan({"short": stage(3), "long": stage(7)}, round=5).shows == 3
    plan = FitPlan({"few": stage(5, frames=[2, 2]), "more": stage(20, frames=[4, 0])}, round=5)
    assert [plan.steps(float(epoch), 10) for epoch in range(5)] == [2, 4, 6, 8, 10]
    schedules = {"default": HalvingSchedule(100, 100), "b": ExponentialSchedule(0.01)}
    made = Stage(300, {"a": 1e-3, "b": 1e-2}, MixedLoss(l1=1.0), schedules=schedules)
    assert [made.rate("a", i) for i in (0, 99, 100, 250)] == [1e-3, 1e-3, 5e-4, 2.5e-4]
    assert made.rate("b", 150) == pytest.approx(1e-3) and made.rate("b", 300) == pytest.approx(1e-4)
    assert made.rate("c", 0) == 0
    assert [LinearSchedule(0.5).factor(i, 10) for i in (0, 5, 20)] == [1, 0.75, 0.5]


@pytest.mark.parametrize(("wrong", "said"), [
    (lambda: stage(0), "iterations >= 1"),
    (lambda: stage(frames=[3]), "frames as two numbers"),
    (lambda: FitPlan({"only": stage()}).check({"b": []}, []), r"only\.rates: \['a'\] asked for; .* has \['b'\]"),
    (lambda: FitPlan({"only": stage(penalties={"rough": 1.0})}).check({"a": []}, ["smooth"]), r"\['rough'\]"),
    (lambda: FitPlan({}, round=0), "model.plan.round"),
])  # fmt: skip
def test_wrong_stages_are_refused(wrong: Callable[[], object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        wrong()
