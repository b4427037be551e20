"""That the model's step asks its device nothing, on any device, and the captured step on a GPU."""

from functools import partial
from typing import Any

import pytest
import torch
from helpers.bodies import join_states, make_model, make_scene, make_state
from helpers.meta_device import asking_nothing
from torch import Tensor

from gausim.core import ConfigError, SimState
from gausim.models.rollout.cuda_graph import GraphedStep, StepFunction
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import MaterialTemplate
from gausim.models.template.template import RestTemplate

ELASTIC = partial(MaterialTemplate, modes=8)
MATERIAL = partial(MaterialTemplate, modes=8)
CASES = pytest.mark.parametrize(("template", "edges"), [(ELASTIC, "rest"), (MATERIAL, "rest"), (RestTemplate, "union")])


def bound(template: Any = ELASTIC, edges: str = "rest", **options: object) -> tuple[GausSim, SimState]:
    """A model of two scenes and a state of both.

    In double precision: sums by atomic additions differ from run to run, and a rollout magnifies it.
    """
    scenes = [make_scene(count, seed=seed, dtype=torch.float64) for seed, count in enumerate((50, 60))]
    model = make_model(scenes, edges=edges, template=template, **options).double()
    return model, join_states([make_state(scene, seed=i) for i, scene in enumerate(scenes)])


@torch.no_grad()
def step_of(model: GausSim) -> StepFunction:
    batch = model.batch((0, 1))
    prepared = model.prepare(batch)
    return lambda state, force: model.step(batch, state, force, prepared)


@torch.no_grad()
def roll(step: StepFunction, state: SimState, force: Tensor | None, steps: int = 4) -> list[Any]:
    """Frames under a force that acts in the odd steps."""
    frames = []
    for number in range(steps):
        frames.append(step(state, force if number % 2 else None))
        state = SimState(frames[-1].positions, state.positions)
    return frames


def assert_same(frames: list[Any], expected: list[Any]) -> None:
    for frame, truth in zip(frames, expected, strict=True):
        for name in ("positions", "deformation_gradients", "rotations"):
            torch.testing.assert_close(getattr(frame, name), getattr(truth, name), atol=1e-5, rtol=1e-5)


@CASES
def test_step_asks_its_device_nothing(monkeypatch: pytest.MonkeyPatch, template: Any, edges: str) -> None:
    """What a graph can capture, and what lets a rollout run ahead: tensors without values stand in for the device's."""
    model, state = bound(template, edges, coarse_inputs=edges == "union", rest_inputs=edges == "union")
    monkeypatch.setattr(model.predictor, "_fixes_shapes", lambda _: edges != "rest")  # as on CUDA
    model.to("meta")
    for level in model.batch((0, 1)).levels:
        _ = level.member, level.device_radii  # kept from then on
    step = step_of(model)
    state = SimState(state.positions.to("meta"), state.previous.to("meta"))
    with torch.no_grad(), asking_nothing():
        frames = roll(step, state, state.previous)
    assert {frame.deformation_gradients.device.type for frame in frames} == {"meta"}


def test_rollouts_on_the_cpu_capture_nothing() -> None:
    scene = make_scene(50)
    models = (make_model(scene, cuda_graph=chosen) for chosen in (False, True))
    found = [SceneDynamics(model).rollout(make_state(scene), 3).positions for model in models]
    assert torch.equal(*found) and not torch.equal(found[0][0], found[0][3])


def on_gpu(model: GausSim, state: SimState) -> SimState:
    model.cuda()
    return SimState(state.positions.cuda(), state.previous.cuda())


@pytest.mark.gpu
@CASES
def test_gpu_replays_equal_the_steps(template: Any, edges: str) -> None:
    model, state = bound(template, edges)
    state = on_gpu(model, state)
    force = torch.full_like(state.positions, 0.3)
    expected = roll(step_of(model), state, force, 8)
    graphed = GraphedStep(step_of(model), state.positions)
    for _ in range(2):  # the first time records
        assert_same(roll(graphed, state, force, 8), expected)
    with torch.no_grad():
        model.predictor.network.decoder[-1].bias.add_(0.05)  # in place: replays read the new weights
    changed = roll(step_of(model), state, force, 8)
    assert float((changed[0].deformation_gradients - expected[0].deformation_gradients).abs().max()) > 1e-3
    assert_same(roll(graphed, state, force, 8), changed)


@pytest.mark.gpu
def test_gpu_step_that_asks_is_refused() -> None:
    model, state = bound()
    state, step = on_gpu(model, state), step_of(model)

    def asking(now: SimState, force: Tensor | None) -> Any:
        assert float(now.positions.sum()) != 0
        return step(now, force)

    with pytest.raises(ConfigError, match="the step cannot be captured"):
        GraphedStep(asking, state.positions)(state)


@pytest.mark.gpu
@CASES
def test_gpu_steps_run_ahead_of_the_device(template: Any, edges: str) -> None:
    """CUDA's own sentinel: torch raises where the host waits."""
    model, state = bound(template, edges)
    state = on_gpu(model, state)
    step, force = step_of(model), torch.full_like(state.positions, 0.3)
    roll(step, state, force)  # whatever is done once
    torch.cuda.set_sync_debug_mode("error")
    try:
        roll(step, state, force)
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.gpu
def test_gpu_rollouts_are_captured_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    replays: list[bool] = []
    call = GraphedStep.__call__
    monkeypatch.setattr(GraphedStep, "__call__", lambda *given: replays.append(True) or call(*given))
    found = []
    for chosen in (False, True):
        model, state = bound(cuda_graph=chosen)
        state = on_gpu(model, state)
        first = SimState(state.positions[:50], state.previous[:50])
        found.append(SceneDynamics(model).rollout(first, 5).positions)
        assert len(replays) == 5 * chosen
    torch.testing.assert_close(found[0], found[1], atol=1e-5, rtol=1e-5)
