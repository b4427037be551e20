"""Drawing and comparing in chunks against the plain way, and what a training step holds."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers import sway, toy_object
from helpers.sway import blobs, sample
from torch import Tensor

from benchmarks.harness import peak_saved_bytes
from gausim.core import GaussianScene, Renderer
from gausim.data.images import composite
from gausim.losses import ImageLoss, Objective
from gausim.models.hierarchy.batch import Member
from gausim.render.draw import SceneAppearance, draw
from gausim.render.reference import ReferenceRenderer
from gausim.training.module import GausSimModule
from gausim.training.rollout import States
from gausim.training.supervision import comparison
from gausim.training.supervision import comparison as chunked
from gausim.training.supervision.comparison import Comparison, ViewGroup

SCENES = (0, 1, 0)  # of the three members
STATE = 3 * toy_object.SIZE**2  # pixels of one


def scene(number: int) -> GaussianScene:
    """The toy with colours that depend on the direction, so that rotations matter."""
    generator = torch.Generator().manual_seed(number)
    toy = toy_object.toy_scene()
    toy = toy if number == 0 else toy.select(torch.arange(toy.count) % 4 != 3)
    return replace(toy, sh=0.4 * torch.rand(toy.count, 4, 3, generator=generator))


class Case:
    def __init__(self, steps: int) -> None:
        self.steps, self.scenes = steps, [scene(0), scene(1)]
        members, kernels, units = [], 0, 0
        for i in SCENES:
            count = self.scenes[i].count
            unit = torch.arange(count) % 2
            rows = slice(kernels, kernels + count), slice(units, units + 2)
            members.append(Member(i, *rows, unit))
            kernels, units = kernels + count, units + 2
        rest = torch.cat([self.scenes[i].means for i in SCENES]).double()
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
    monkeypatch.setattr(chunked, "CPU_PIXELS", pixels)
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


def test_stretches_continue_where_the_last_one_ended() -> None:
    case = Case(steps=5)
    whole, motion = case.comparison()(case.states, 0)
    work = case.comparison()
    parts = [work(States(*(x[span] for x in case.states)), span.start) for span in (slice(0, 2), slice(2, 5))]
    torch.testing.assert_close(torch.cat([losses for losses, _ in parts]), whole, rtol=1e-6, atol=0)
    torch.testing.assert_close(sum(m for _, m in parts), motion, rtol=1e-12, atol=0)


def test_no_image_is_held_for_the_backward_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunked, "CPU_PIXELS", STATE)
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
