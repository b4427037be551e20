"""Training on true points and on pictures in chunks, against plain formulas; what a training step holds."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers import sway, toy_object
from torch import Tensor

from benchmarks.harness import peak_saved_bytes
from benchmarks.reference_renderer import ReferenceRenderer
from gausim.core import GaussianScene, Renderer, SimState, Trajectory
from gausim.data.images import composite
from gausim.data.records import GroundTruth
from gausim.losses import ImageLoss, Objective
from gausim.metrics import point_error
from gausim.models.hierarchy.batch import Member
from gausim.render.draw import SceneAppearance, draw
from gausim.training.method import SharedSimulator
from gausim.training.module import GausSimModule
from gausim.training.rollout import States, windows
from gausim.training.supervision import comparison
from gausim.training.supervision.comparison import Comparison, ViewGroup
from gausim.training.supervision.images import Sources
from gausim.training.supervision.points import PointSupervision, attach_points

sample, blobs = sway.sample, sway.blobs
SCENE = toy_object.toy_scene()


def truth(frames: int = 6) -> GroundTruth:
    generator = torch.Generator().manual_seed(3)
    rest = SCENE.means[::3] + 0.01 * torch.randn(SCENE.means[::3].shape, generator=generator)
    moved = rest + 0.05 * torch.randn(frames, *rest.shape, generator=generator).cumsum(0)
    moved[0] = rest
    return GroundTruth(rest, moved)


def sources(truth: Callable[[int], GroundTruth | None], scenes: Sequence[GaussianScene] = (SCENE,)) -> Sources:
    return Sources(scenes, truth, lambda scene_id: None, ReferenceRenderer(), ImageLoss())


def batch(members: int) -> SimpleNamespace:
    """Members of two units each, of which every other kernel belongs to the second."""
    count, unit = SCENE.count, torch.arange(SCENE.count) % 2
    rows = [(slice(i * count, (i + 1) * count), slice(2 * i, 2 * i + 2)) for i in range(members)]
    return SimpleNamespace(rest=SCENE.means.repeat(members, 1), members=tuple(Member(0, *row, unit) for row in rows))


def states(steps: int, members: int) -> States:
    g = torch.Generator().manual_seed(4)
    positions = SCENE.means.repeat(members, 1) + 0.1 * torch.randn(steps, members * SCENE.count, 3, generator=g)
    deformation_gradients = torch.eye(3) + 0.3 * torch.randn(steps, 2 * members, 3, 3, generator=g)
    rotations = torch.eye(3).expand_as(deformation_gradients)
    return States(positions.requires_grad_(), deformation_gradients.requires_grad_(), rotations)


def plain(known: GroundTruth, made: States, member: int) -> Tensor:
    """Positions of the points as the evaluation carries them."""
    rows, units = slice(member * SCENE.count, (member + 1) * SCENE.count), slice(2 * member, 2 * member + 2)
    parts = made.positions[:, rows], made.deformation_gradients[:, units], made.rotations[:, units]
    trajectory = Trajectory(*parts, torch.arange(SCENE.count) % 2, 24.0)
    return trajectory.carry(known.rest, attach_points(SCENE, known.rest), SCENE.means)


def compared(known: GroundTruth, made: States, members: int = 1, **options: float) -> tuple[Tensor, Tensor]:
    """Losses and squared change of states of the first sequences, all T frames in one stretch."""
    supervision = PointSupervision(sources(lambda number: known), **options)  # type: ignore[arg-type]
    return supervision.comparison([sample(i, 5) for i in range(members)], batch(members))(made, 0)


def test_losses_are_squared_distances_in_percent_and_reach_positions_and_gradients() -> None:
    known, made = truth(), states(4, 2)
    losses, motion = compared(known, made, 2)
    assert losses.shape == (4, 2) and not motion.requires_grad
    expected, moved = [], 0.0
    for member in range(2):
        points = plain(known, made, member)
        distance = 100 * (points - known.positions[1:5]).norm(dim=-1) / SCENE.diagonal
        expected.append(distance.square().mean(1))
        before = torch.cat((known.rest[None], points[:-1]))
        moved += float((100 * (points.detach() - before.detach()).norm(dim=-1) / SCENE.diagonal).square().mean(1).sum())
    torch.testing.assert_close(losses, torch.stack(expected, 1))
    assert float(motion) == pytest.approx(moved, rel=1e-5)
    totals, inputs = (losses.sum(), torch.stack(expected).sum()), [made.positions, made.deformation_gradients]
    for gradient, other in zip(*(torch.autograd.grad(total, inputs) for total in totals), strict=True):
        assert float(other.norm()) > 0
        torch.testing.assert_close(gradient, other)


def test_stretches_continue_where_the_last_one_ended() -> None:
    known, made = truth(), states(5, 1)
    whole, motion = compared(known, made)
    work = PointSupervision(sources(lambda number: known)).comparison([sample(0, 5)], batch(1))
    parts = [work(States(*(x[s] for x in made)), s.start) for s in (slice(0, 2), slice(2, 5))]
    torch.testing.assert_close(torch.cat([p[0] for p in parts]), whole)
    assert float(sum(p[1] for p in parts)) == pytest.approx(float(motion), rel=1e-6)


def test_the_rest_state_scores_the_true_displacement_and_only_of_the_samples_frames() -> None:
    known = truth(frames=9)
    poisoned = GroundTruth(known.rest, known.positions.clone())
    poisoned.positions[4:] = torch.nan  # frames that the sample does not hold
    supervision = PointSupervision(sources(lambda number: poisoned))
    losses, motion = supervision.static(sample(0, 3), SCENE.means, 0)
    assert losses[0] == 0 and len(losses) == 4 and len(motion) == 3
    percent = 100 * (known.positions[:4] - known.rest).norm(dim=-1) / SCENE.diagonal
    assert losses == pytest.approx(percent.square().mean(1).tolist(), rel=1e-5)
    # The same measure as the evaluation's, but squared before the mean.
    assert torch.all(torch.tensor(losses).sqrt() >= point_error(known.rest.expand(4, -1, -1), known.positions[:4],
                                                                SCENE.diagonal) - 1e-5)  # fmt: skip
    step = 100 * known.positions[:4].diff(dim=0).norm(dim=-1) / SCENE.diagonal
    assert motion == pytest.approx(step.square().mean(1).tolist(), rel=1e-5)
    assert supervision.static(sample(0, 3), SCENE.means, 2).losses == losses[2:]


def test_a_module_learns_from_points_and_draws_nothing() -> None:
    model = sway.Sway([SCENE])
    with torch.no_grad():
        model.drift[0].fill_(0.02)
        whole, state = model.batch([0]), SimState(SCENE.means, SCENE.means)
        made = [step.positions for _, steps in windows(model, whole, state, 3, 3) for step in steps]
        model.drift[0].zero_()
    known = GroundTruth(SCENE.means, torch.stack([SCENE.means, *made]))

    def refuse(*args: object, **options: object) -> object:
        raise AssertionError("drawn")

    module = GausSimModule(
        method=SharedSimulator(model, sway.Previous(model, (0, 0)), (0, 0)),
        renderer=refuse,  # type: ignore[arg-type]
        objective=Objective(static_weight=0.0, momentum_weight=0.0, backprop_steps=0),
        optimizer=sway.OptimizerSettings(network_lr=2e-3, scene_lr=2e-3, initial_lr=2e-4),
        supervision=PointSupervision(sources(lambda number: known)),
    )
    optimizer, draws = module.configure_optimizers(), torch.Generator().manual_seed(0)
    found = [module.optimise([sample(0), sample(1)], optimizer, draws) for _ in range(30)]
    assert found[0]["ratio_static"] == pytest.approx(1.0) and found[0]["motion_energy"] < 1e-6
    assert found[-1]["ratio_static"] < 0.1 and 0.6 < found[-1]["motion_energy"] < 1.4
    assert float(model.drift[0].detach()) == pytest.approx(0.02, rel=0.3)


def test_energy_of_each_half_counts_by_its_logarithm_in_units_of_the_rest_state() -> None:
    known, made = truth(), states(5, 1)
    plain_loss, weighted = (compared(known, made, energy_weight=weight)[0] for weight in (0.0, 2.0))
    percent = (100 / SCENE.diagonal) ** 2
    points = torch.cat((known.rest[None], plain(known, made, 0)))
    energy, true = (x.diff(dim=0).square().sum(-1).mean(1) for x in (points, known.positions[:6]))
    mismatch = []
    for half in (slice(0, 3), slice(3, 5)):
        least = 0.05 * true[half].mean()
        mismatch.append(((energy[half].mean() + least) / (true[half].mean() + least)).log().square())
    still = percent * (known.positions[1:6] - known.rest).square().sum(-1).mean(1)
    torch.testing.assert_close(weighted - plain_loss, (2 * still * sum(mismatch) / 2)[:, None])


def test_energy_of_a_motion_that_has_not_begun_has_a_gradient() -> None:
    known = truth()
    still = SCENE.means.repeat(3, 1, 1).requires_grad_()
    identity = torch.eye(3).expand(3, 2, 3, 3)
    supervision = PointSupervision(sources(lambda number: known), energy_weight=1.0)
    losses = supervision.comparison([sample(0, 3)], batch(1))(States(still, identity, identity), 0)[0]
    losses.sum().backward()
    assert bool(torch.isfinite(still.grad).all())
    expected = torch.tensor(supervision.static(sample(0, 3), SCENE.means, 0).losses[1:])
    torch.testing.assert_close(losses[:, 0].detach(), expected, rtol=1e-3, atol=0)  # points lie off their kernels


MEMBERS = (0, 1, 0)  # of the three members
STATE = 3 * toy_object.SIZE**2  # pixels of one


def coloured(number: int) -> GaussianScene:
    """The toy with colours that depend on the direction, so that rotations matter."""
    generator = torch.Generator().manual_seed(number)
    toy = toy_object.toy_scene()
    toy = toy if number == 0 else toy.select(torch.arange(toy.count) % 4 != 3)
    return replace(toy, sh=0.4 * torch.rand(toy.count, 4, 3, generator=generator))


class Case:
    def __init__(self, steps: int) -> None:
        self.steps, self.scenes = steps, [coloured(0), coloured(1)]
        members, kernels, units = [], 0, 0
        for i in MEMBERS:
            count = self.scenes[i].count
            unit = torch.arange(count) % 2
            rows = slice(kernels, kernels + count), slice(units, units + 2)
            members.append(Member(i, *rows, unit))
            kernels, units = kernels + count, units + 2
        rest = torch.cat([self.scenes[i].means for i in MEMBERS]).double()
        self.batch = SimpleNamespace(rest=rest, members=tuple(members))
        generator = torch.Generator().manual_seed(9)
        moved = rest + 0.05 * torch.randn(steps, *rest.shape, generator=generator).double()
        change = torch.eye(3) + 0.2 * torch.randn(steps, units, 3, 3, generator=generator).double()
        rotations = torch.linalg.qr(change)[0]
        self.states = States(*(x.requires_grad_() for x in (moved, change, rotations)))
        size = toy_object.SIZE
        self.frames = list(torch.randint(0, 256, (3, steps, 3, size, size, 4), generator=generator).to(torch.uint8))
        self.rest_images = list(torch.rand(3, 3, size, size, 3, generator=generator).double())
        self.looks = [SceneAppearance.of(s).to(rest) for s in self.scenes]
        self.loss = ImageLoss(pixels=1000)

    def comparison(self, renderer: Renderer | None = None) -> Comparison:
        groups = [ViewGroup(0, (0, 2), toy_object.cameras()), ViewGroup(1, (1,), toy_object.cameras())]
        renderer = renderer or ReferenceRenderer()
        return Comparison(renderer, self.loss, self.batch, groups, self.looks, self.frames, list(self.rest_images))

    def plain(self) -> tuple[Tensor, Tensor]:
        """Losses and motion with all images in one graph."""
        losses, motion = [], torch.zeros(()).double()
        for i, member in enumerate(self.batch.members):
            rows = member.kernels, member.units, member.units
            states = [x[:, r] for x, r in zip(self.states, rows, strict=True)]
            look, cameras = self.looks[member.scene_id], toy_object.cameras()
            images = draw(ReferenceRenderer(), look, *states, member.unit_of_kernel, cameras).rgb
            losses.append(self.loss(images, composite(self.frames[i])[0]))
            before = torch.cat((self.rest_images[i][None], images[:-1]))
            motion = motion + (images - before).square().sum()
        return torch.stack(losses, 1), motion


@pytest.mark.parametrize("pixels", [1, 3 * STATE, 9 * STATE, 10**9])
def test_chunks_give_what_one_graph_gives(pixels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "CPU_PIXELS", pixels)
    case = Case(steps=4)
    losses, motion = case.comparison()(case.states, 0)
    expected, moved = case.plain()
    torch.testing.assert_close(losses, expected, rtol=1e-6, atol=0)
    torch.testing.assert_close(motion, moved.detach(), rtol=1e-12, atol=0)
    assert not motion.requires_grad
    weights = torch.rand(expected.shape, generator=torch.Generator().manual_seed(2)).double()
    found, plain_ones = (torch.autograd.grad(x, case.states, weights) for x in (losses, expected))
    for ours, plain in zip(found, plain_ones, strict=True):
        assert float(plain.norm()) > 0
        assert float((ours - plain).norm()) <= 1e-6 * float(plain.norm())


def test_stretches_of_pictures_continue_too() -> None:
    case = Case(steps=5)
    whole, motion = case.comparison()(case.states, 0)
    work = case.comparison()
    parts = [work(States(*(x[span] for x in case.states)), span.start) for span in (slice(0, 2), slice(2, 5))]
    torch.testing.assert_close(torch.cat([losses for losses, _ in parts]), whole, rtol=1e-6, atol=0)
    torch.testing.assert_close(sum(m for _, m in parts), motion, rtol=1e-12, atol=0)


def test_no_image_is_held_for_the_backward_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "CPU_PIXELS", STATE)
    held = {}
    for steps in (3, 12):
        case = Case(steps)
        held[steps] = peak_saved_bytes(lambda case=case: case.comparison(blobs)(case.states, 0))
    states = sum(x[0].numel() * 8 for x in case.states)
    assert held[12] - held[3] <= 9 * states
    one_image = 8 * 3 * STATE
    assert states < one_image  # so the bound above tells states from images


def real_module(objective: Objective) -> GausSimModule:
    parts = {"renderer": blobs, "objective": objective}
    return sway.real_module(edges="rest", layers=2, output_scale=0.1, parts=parts)


def optimise(module: GausSimModule, steps: int = 3, times: int = 1) -> dict[str, float]:
    optimizer = module.configure_optimizers()
    stats: dict[str, float] = {}
    for number in range(times):
        stats = module.optimise([sample(0, steps=steps)], optimizer, torch.Generator().manual_seed(number))
    return stats


@pytest.fixture
def one_state_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "CPU_PIXELS", 1)


def held(objective: Objective, steps: int) -> int:
    return peak_saved_bytes(lambda: optimise(real_module(objective), steps))


def test_memory_does_not_grow_with_the_rollout_where_gradients_stop(one_state_at_once: None) -> None:
    stopped = Objective(backprop_steps=1, static_weight=0.0)
    assert held(stopped, 8) == held(stopped, 3) > 0
    whole = Objective(backprop_steps=0, static_weight=0.0)
    assert held(whole, 12) > 2 * held(whole, 3)
