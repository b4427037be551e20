"""Motion tracked in images against the motion that they were drawn from."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from helpers import sway, toy_object
from helpers.simulators import gausim
from torch import Tensor

from gausim.core import Frame, GaussianScene, HandPath, SmoothMotions
from gausim.data.dataset import SequenceSample
from gausim.losses import ImageLoss
from gausim.models.initial_state import ModalInitialStates
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import MaterialTemplate
from gausim.ops.deformation import polar_rotation
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import draw
from gausim.training.method import SharedSimulator
from gausim.training.module import GausSimModule
from gausim.training.rollout import States
from gausim.training.supervision.images import Sources
from gausim.training.supervision.motion_tracks import MotionTracker, TrackSupervision
from gausim.training.supervision.points import PointSupervision

SCENE = toy_object.toy_scene()
FRAMES, MODES = 5, 6
ELASTIC = partial(MaterialTemplate, modes=MODES)


def small(scene: GaussianScene, **options: Any) -> GausSim:
    torch.manual_seed(0)
    return gausim([scene], [24.0], radii=(0.2, 0.5), graph_radii=(2.0, 0.6), hidden=8, layers=1, **options)


@pytest.fixture(scope="module")
def model() -> GausSim:
    return small(SCENE, template=ELASTIC, output_scale=0.01)


@pytest.fixture
def sources(model: GausSim) -> Sources:
    return Sources([SCENE], lambda number: None, model.smooth_motions, CpuRenderer(), ImageLoss(balance=0.5))


@pytest.fixture(scope="module")
def coordinates() -> Tensor:
    """A motion of several modes, one tenth of the object's diagonal wide."""
    t = torch.arange(FRAMES)[:, None] * torch.linspace(0.4, 1.1, MODES)
    return t.sin() * torch.tensor([1.3, -1.0, 0.8, 0.5, -0.5, 0.3])


@pytest.fixture(scope="module")
def filmed(model: GausSim, coordinates: Tensor) -> SequenceSample:
    motions = model.smooth_motions(0)
    assert motions is not None
    return _film(_state(motions, coordinates), motions.unit_of_kernel)


def _state(motions: SmoothMotions, coordinates: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    deformations = motions.deformations(coordinates)
    return SCENE.means + motions.displacements(coordinates), deformations, polar_rotation(deformations)


def _film(state: Sequence[Tensor], unit_of_kernel: Tensor) -> SequenceSample:
    """A sample whose frames show the kernels, deformation gradients and rotations of a state."""
    drawn = draw(CpuRenderer(), SCENE, *state, unit_of_kernel, toy_object.cameras())
    straight = drawn.rgb / drawn.alpha.clamp_min(1e-6)[..., None]
    rgba = (torch.cat((straight, drawn.alpha[..., None]), -1).clamp(0, 1) * 255).round().to(torch.uint8)
    return replace(sway.sample(0, FRAMES - 1), frames=rgba)


def test_motion_of_several_modes_is_found_in_the_images(model, sources, filmed, coordinates) -> None:
    found = MotionTracker(sources).extend(None, filmed)
    motions = model.smooth_motions(0)
    assert motions is not None and found.shape == (FRAMES, MODES)
    true, made = motions.displacements(coordinates), motions.displacements(found)
    error = (made - true).norm(dim=-1).mean(1)[1:] / true.norm(dim=-1).mean(1)[1:]
    assert float(true.norm(dim=-1).max()) > 0.1 * SCENE.diagonal
    assert float(error.max()) < 0.1, error


def test_motion_about_moving_hands_is_found_in_the_images(sources: Sources, coordinates: Tensor) -> None:
    scene = replace(SCENE, hand=torch.where(SCENE.pinned, 0, -1))
    model = small(scene, template=ELASTIC)
    corners = torch.tensor([[0.1, 0.0, 0.0], [-0.1, 0.1, 0.0], [0.0, -0.1, 0.0]])
    way = torch.linspace(0, 0.4, FRAMES)[:, None, None] * torch.tensor([1.0, 0.5, 0.0])
    path = HandPath.of(corners + way, torch.zeros(3, dtype=torch.long))
    method = SharedSimulator(model, ModalInitialStates(model, [0]), [0], [path])
    references = method.references(0, FRAMES - 1)
    motions = model.smooth_motions(0)
    assert motions is not None and references is not None
    made = _state(motions, 0.5 * coordinates)
    rows = [Frame(*own) for own in zip(*made, strict=True)]
    placed = [rows[0], *(carried.place(row) for (carried, _), row in zip(references, rows[1:], strict=True))]
    state = States.of(placed)
    moved = (state[0][-1] - SCENE.means)[SCENE.pinned]
    torch.testing.assert_close(moved, way[-1].expand_as(moved))
    filmed = _film(state, motions.unit_of_kernel)
    tracks = TrackSupervision(replace(sources, motions=model.smooth_motions, references=method.references))
    found, free = tracks.motion(filmed).positions, ~SCENE.pinned
    error = (found - state[0][:, free]).norm(dim=-1).mean(1)
    relative = motions.displacements(0.5 * coordinates).norm(dim=-1).mean(1)
    assert float((error[1:] / relative[1:]).max()) < 0.2, error / relative
    # Hands that move evenly, without turning, are no load.
    assert all(float(units.load.abs().max()) < 1e-5 for _, units in references)


def test_tracking_in_two_calls_gives_the_same_bits(sources: Sources, filmed: SequenceSample) -> None:
    tracker = MotionTracker(sources, iterations=5)
    whole = tracker.extend(None, filmed)
    part = tracker.extend(None, replace(filmed, frames=filmed.frames[:3]))
    assert torch.equal(tracker.extend(part, filmed), whole)
    later = filmed.frames.clone()
    later[3:] = 0  # frames that come after have no say
    assert torch.equal(tracker.extend(None, replace(filmed, frames=later))[:3], whole[:3])


def test_losses_are_those_of_the_tracked_kernels(model: GausSim, sources: Sources, filmed: SequenceSample) -> None:
    supervision = TrackSupervision(sources, iterations=5)
    known = supervision.motion(filmed)
    free = SCENE.simulated & ~SCENE.pinned
    assert known.positions.shape == (FRAMES, int(free.sum()), 3)
    assert torch.equal(known.positions[0], SCENE.means[free])
    plain = PointSupervision(replace(sources, truth=lambda number: known), energy_weight=0.3)
    assert supervision.static(filmed, SCENE.means, 0) == plain.static(filmed, SCENE.means, 0)
    assert supervision.static(filmed, SCENE.means, 0).losses[-1] > 0


def test_what_was_tracked_is_not_tracked_again(sources, filmed, monkeypatch) -> None:
    first = TrackSupervision(sources, iterations=2)
    known = first.motion(filmed)
    resumed = TrackSupervision(sources, iterations=2)
    resumed.load_state_dict(first.state_dict())
    monkeypatch.setattr(MotionTracker, "extend", lambda *unused: pytest.fail("tracked again"))
    assert torch.equal(resumed.motion(filmed).positions, known.positions)
    shorter = replace(filmed, frames=filmed.frames[:3])
    assert torch.equal(resumed.motion(shorter).positions, known.positions)


def test_a_few_steps_of_training_come_nearer_and_keep_the_tracks(model, sources, filmed) -> None:
    module = GausSimModule(
        method=SharedSimulator(model, ModalInitialStates(model, [0]), [0]),
        renderer=CpuRenderer(),
        optimizer=replace(sway.OptimizerSettings(), template_lr=2e-3, initial_lr=6e-3),
        supervision=TrackSupervision(sources, iterations=20),
    )
    optimizer, draws = module.configure_optimizers(), torch.Generator().manual_seed(0)
    found = [module.optimise([filmed], optimizer, draws) for _ in range(14)]
    assert found[-1]["excess_static"] < 0.5 * found[0]["excess_static"]
    checkpoint: dict[str, object] = {}
    module.on_save_checkpoint(checkpoint)
    assert checkpoint["gausim"]["tracks"][0].shape == (FRAMES, MODES)
