"""Rollouts: what steps give, memory of earlier frames, divergence."""

from dataclasses import replace

import pytest
import torch
from helpers.bodies import make_model, make_scene, make_state

from gausim.core import ConfigError, DivergenceError, Dynamics, SimState
from gausim.core.surroundings import Surroundings
from gausim.models.rollout.dynamics import SceneDynamics


def test_offers_the_protocol_and_rolls_out_what_steps_give() -> None:
    scenes = [make_scene(50), make_scene(60, seed=1)]
    model = make_model(scenes)
    dynamics = SceneDynamics(model, 1)
    assert isinstance(dynamics, Dynamics)
    state = make_state(scenes[1])
    force = torch.randn(60, 3, generator=torch.Generator().manual_seed(0))

    def poke(frame: int):
        return force if frame == 1 else None

    trajectory = dynamics.rollout(state, 4, forces=poke)
    assert trajectory.frames == 5 and trajectory.fps == 30.0 and not trajectory.positions.requires_grad
    assert torch.equal(trajectory.positions[0], state.positions)
    assert torch.equal(trajectory.deformation_gradients[0], torch.eye(3).expand_as(trajectory.deformation_gradients[0]))
    current = state
    for frame in range(4):
        with torch.no_grad():
            step = model.step(model.batch((1,)), current, poke(frame))
        current = SimState(step.positions, current.positions)
        assert torch.equal(trajectory.positions[frame + 1], step.positions)
        assert torch.equal(trajectory.deformation_gradients[frame + 1], step.deformation_gradients)
        assert torch.equal(trajectory.rotations[frame + 1], step.rotations)
    still = dynamics.rollout(state, 4)
    assert torch.equal(still.positions[1], trajectory.positions[1])
    assert not torch.equal(still.positions[2], trajectory.positions[2])


def test_rollout_leaves_mode_and_statistics_alone() -> None:
    scene = make_scene(50)
    model = make_model(scene).train()
    before = {k: v.clone() for k, v in model.state_dict().items()}
    SceneDynamics(model).rollout(make_state(scene), 3)
    assert model.training and model.predictor.node_normaliser.training
    assert all(torch.equal(v, before[k]) for k, v in model.state_dict().items())


def test_points_are_carried_by_the_unit_of_their_kernel() -> None:
    scene = make_scene(80, dtype=torch.float64)
    model = make_model(scene, output_scale=3.0)
    trajectory = SceneDynamics(model).rollout(make_state(scene), 3)
    generator = torch.Generator().manual_seed(0)
    kernel = torch.randint(0, 80, (50,), generator=generator)
    points = scene.means[kernel] + 0.02 * torch.randn(50, 3, generator=generator, dtype=torch.float64)
    carried = trajectory.carry(points, kernel, scene.means)
    hierarchy = model.hierarchies[0]
    unit = torch.full((80,), -1)
    unit[hierarchy.kernels] = hierarchy.ancestor(0, 1)
    free = scene.simulated & ~scene.pinned
    mass = torch.zeros(80, dtype=torch.float64)
    mass[hierarchy.kernels] = model.masses(model.batch((0,)))[0].detach()
    assert int(free[kernel].sum()) > 20
    for frame in range(1, 4):
        for p, k in enumerate(kernel.tolist()):
            expected = points[p]
            if free[k]:
                members = unit == unit[k]
                weight = mass[members, None] / mass[members].sum()
                both = scene.means, trajectory.positions[frame]
                rest, now = ((weight * x[members]).sum(0) for x in both)
                gradient = trajectory.deformation_gradients[frame, trajectory.unit_of_kernel[k]]
                expected = now + gradient @ (points[p] - rest)
            assert torch.allclose(carried[frame, p], expected, atol=1e-12)


@pytest.mark.parametrize("edges", ["rest", "union"])
def test_numbers_that_are_not_finite_stop_the_rollout_and_name_the_frame(edges) -> None:
    scene = make_scene(50)
    model = make_model(scene, edges=edges)
    state, nan = make_state(scene), torch.full((50, 3), float("nan"))
    with pytest.raises(DivergenceError, match="column0: positions are not finite at frame 0"):
        SceneDynamics(model).rollout(SimState(state.positions, nan), 3)
    with pytest.raises(DivergenceError, match="column0: forces are not finite at frame 2"):
        SceneDynamics(model).rollout(state, 3, forces=lambda frame: nan if frame == 2 else None)
    with torch.no_grad():
        model.predictor.network.decoder[-1].bias.fill_(float("nan"))
    model.train()
    with pytest.raises(DivergenceError, match="column0: positions are not finite at frame 1"):
        SceneDynamics(model).rollout(state, 3)
    assert model.training  # restored after the error too


def test_a_device_is_asked_now_and_then_and_at_the_end() -> None:
    scene = make_scene(50)
    stepper = SceneDynamics(make_model(scene, edges="rest")).stepper(make_state(scene))
    stepper._interval = 4  # as on a GPU
    for _ in range(5):
        stepper.step()
    stepper.step(torch.full((50, 3), float("inf")))
    stepper.step()
    with pytest.raises(DivergenceError, match="column0: positions are not finite at one of the frames 5 to 7"):
        stepper.settle()


def test_unknown_frames_continue_backwards_and_memory_is_refused_where_bodies_move() -> None:
    x = torch.arange(12.0).view(4, 3)
    step = torch.ones(4, 3)
    older = SimState(x, x - step).remembering(2).older
    assert all(torch.equal(a, b) for a, b in zip(older, (x - 2, x - 3), strict=True))
    known = SimState(x, x - step, (x - 5 * step,)).remembering(3).older
    assert all(torch.equal(a, b) for a, b in zip(known, (x - 5, x - 9, x - 13), strict=True))
    assert SimState(x, x, (x, x)).remembering(1).older[0] is x and SimState(x, x).remembering(0).older == ()
    free = replace(make_scene(60), surroundings=Surroundings(free=True))
    with pytest.raises(ConfigError, match=r"history: expected 0 where bodies are free"):
        make_model(free, history=2)
    with pytest.raises(ConfigError, match=r"history: expected at least 0, got -1"):
        make_model(make_scene(60), history=-1)


def test_a_rollout_carries_the_frames_that_the_network_sees() -> None:
    torch.manual_seed(0)
    scene = make_scene(60)
    model = make_model(scene, history=2).eval()
    assert model.predictor.features.node_normalised == 6 + 6
    batch, state = model.batch((0,)), make_state(scene)
    first = model.step(batch, state)
    even = model.step(batch, state.remembering(2))
    assert torch.equal(first.positions, even.positions)
    after = first.following(state)
    assert torch.equal(after.positions, first.positions) and torch.equal(after.previous, state.positions)
    assert torch.equal(after.older[0], state.previous) and len(after.older) == 2
    other = replace(after, older=(after.older[0], after.older[1] + 0.1))
    assert not torch.allclose(model.step(batch, after).positions, model.step(batch, other).positions)
    with torch.no_grad():
        twice = model.step(batch, after).positions
    assert torch.allclose(SceneDynamics(model).rollout(state, 2).positions[2], twice, atol=1e-6)
