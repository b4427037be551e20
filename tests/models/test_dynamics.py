"""Rollouts: what steps give, memory of earlier frames, divergence."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers.bodies import make_model, make_scene, make_state

from gausim.core import ConfigError, DivergenceError, Dynamics, Frame, GaussianScene, SimState
from gausim.core.surroundings import Surroundings
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.rollout.energy_guard import EnergyGuard
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import MaterialTemplate


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
    force = torch.ones(60, 3)
    assert torch.equal(model.step(batch, state, force).following(state).previous, state.positions)
    other = replace(after, older=(after.older[0], after.older[1] + 0.1))
    assert not torch.allclose(model.step(batch, after).positions, model.step(batch, other).positions)
    with torch.no_grad():
        twice = model.step(batch, after).positions
    assert torch.allclose(SceneDynamics(model).rollout(state, 2).positions[2], twice, atol=1e-6)


FRAMES = 10


def _model(scene: GaussianScene, *, frames: int = FRAMES, scale: float = 0.05) -> GausSim:
    """A network with random weights of a size that feeds the motion of an elastic template."""
    template = partial(MaterialTemplate, modes=8)
    return make_model(scene, template=template, output_scale=scale, energy_guard_frames=frames).eval()


def _energies(model: GausSim, positions: torch.Tensor) -> list[float]:
    batch = model.batch((0,))
    with torch.no_grad():
        return [float(model.energy(batch, SimState(b, a))) for a, b in zip(positions, positions[1:], strict=False)]


def test_energy_grows_without_the_guard_and_not_with_it() -> None:
    scene = make_scene()
    state = SimState(scene.means, make_state(scene).positions)
    found, model = {}, _model(scene, scale=0.07)
    for frames in (0, FRAMES):
        rollout = SceneDynamics(_model(scene, frames=frames, scale=0.07)).rollout(state, 70)
        positions = torch.cat((state.previous[None], rollout.positions))
        found[frames] = _energies(model, positions)
    assert max(found[0][FRAMES:]) > 1.2 * max(found[0][:FRAMES])
    kept = found[FRAMES]
    for i in range(FRAMES, len(kept)):
        assert kept[i] <= max(kept[i - FRAMES : i]) * (1 + 1e-4)
    prepared = model.prepare(model.batch((0,)))
    steps = list(zip(positions, positions[1:], positions[2:], strict=False))[FRAMES:-1]
    with torch.no_grad():
        taken = [float(model.dissipated(prepared, SimState(after, now), before)) for before, now, after in steps]
        lost = torch.tensor(taken).cumsum(0)
    limits = max(kept[:FRAMES]) - lost
    assert (torch.tensor(kept[FRAMES + 2 :]) <= limits * (1 + 1e-4)).all()  # in the end damping wins
    assert float(limits[-1]) < 0.95 * float(limits[0]) and min(kept[-FRAMES:]) > 0


def test_a_push_raises_the_limit_by_its_work() -> None:
    scene = make_scene()
    model = _model(scene, scale=0.0)
    still = SimState(scene.means, scene.means)

    def push(frame: int) -> torch.Tensor | None:
        return torch.full_like(scene.means, 1.0) * SceneDynamics(model).masses[:, None] if frame in (3, 4) else None

    guarded = SceneDynamics(model).rollout(still, 20, forces=push)
    model.rollout = replace(model.rollout, energy_guard_frames=0)
    assert torch.equal(guarded.positions, SceneDynamics(model).rollout(still, 20, forces=push).positions)
    assert float((guarded.positions[8] - scene.means).norm(dim=-1).max()) > 1e-4


@torch.no_grad()
def test_a_held_back_step_takes_the_share_of_its_formula() -> None:
    scene = make_scene()
    model = _model(scene, scale=0.002)
    batch = model.batch((0,))
    prepared = model.prepare(batch)
    guard = EnergyGuard(model, prepared, lambda state, force: model.step(batch, state, force, prepared))
    state = SimState(scene.means, make_state(scene).positions)
    energies: list[float] = [float(model.energy(batch, state))]
    left = list(energies)  # what damping left of them

    while not guard.held and len(energies) < 200:
        start, limit = state, max(left[-FRAMES:])
        state = SimState(guard.step(start, None).positions, start.positions)
        energies.append(float(model.energy(batch, state)))
        lost = float(model.dissipated(prepared, state, start.previous))
        left = [energy - lost for energy in left] + energies[-1:]

    def energy_with(share: float) -> float:
        made = model.step(batch, start, None, prepared, share)
        return float(model.energy(batch, SimState(made.positions, start.positions)))

    low, high = energy_with(0.0), energy_with(1.0)
    share = (limit - low) / (high - low)
    assert guard.held == 1 and low < limit < high and energies[-1] <= limit
    assert 0.01 < share < 0.99
    assert torch.equal(state.positions, model.step(batch, start, None, prepared, share).positions)


GROWTH, TURN = 1.02, 0.5  # of an oscillation per frame, and its angular frequency [1 / frame]


@torch.no_grad()
def test_what_a_taught_network_makes_grow_dies_away_with_the_guard(monkeypatch) -> None:
    scene = make_scene(dtype=torch.float64)
    model = make_model(scene, energy_guard_frames=24).eval()
    free = (scene.simulated & ~scene.pinned)[:, None].double()

    def growing(batch, state, force, prepared, *_):
        state = state if force is None else model.pushed(prepared, state, force)
        now, before = state.positions - scene.means, state.previous - scene.means
        after = free * (2 * GROWTH * math.cos(TURN) * now - GROWTH**2 * before)
        return Frame(scene.means + after, *prepared.reference.undeformed(state))

    monkeypatch.setattr(model, "step", growing)
    still = SimState(scene.means, scene.means)
    bent = SimState(make_state(scene).positions, scene.means)

    def away(state: SimState, frames: int, push: torch.Tensor | None = None) -> list[float]:
        made = SceneDynamics(model).rollout(state, frames, forces=lambda n: push if n == 2 else None)
        return (made.positions - scene.means).flatten(1).norm(dim=1).tolist()

    push = SceneDynamics(model).masses[:, None] * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    alone, driven = away(bent, 200), away(still, 40, push)
    model.template.oscillator(0).copy_(torch.tensor([TURN, 0.0]))
    bounded, kept = away(bent, 200), away(still, 40, push)
    model.template.oscillator(0)[1] = 0.02  # of the energy, per frame
    damped = away(bent, 200)
    assert max(alone[100:]) > 5 * max(alone[:100]) and max(away(still, 40)) == 0.0
    assert max(bounded[150:]) < 0.9 * max(bounded[:50]) and max(bounded[150:]) > 0.3 * max(bounded[:50])
    assert max(kept[:8]) == pytest.approx(max(driven[:8]), rel=0.1)  # a quarter of a period after the push
    assert max(kept[20:]) <= max(kept[:20])
    assert max(damped[150:]) == pytest.approx(max(damped[50:100]) * 0.98 ** (100 / 2), rel=0.1)


def test_a_ceiling_bounds_what_forces_do() -> None:
    """A strong steady force throws the object away without it."""
    scene = make_scene()
    model = _model(scene, scale=0.002)
    still = SimState(scene.means, scene.means)
    push = 60.0 * SceneDynamics(model).masses[:, None] * torch.tensor([0.3, 1.0, 0.2])
    small = SceneDynamics(model).rollout(still, 6, forces=lambda n: 0.2 * push if n < 2 else None)
    ceiling = max(_energies(model, small.positions))

    def pushed(energy_ceiling: float | None, frames: int = 30) -> torch.Tensor:
        dynamics = SceneDynamics(model, 0, energy_ceiling=energy_ceiling)
        return dynamics.rollout(still, frames, forces=lambda _: push).positions

    free, bound = pushed(None), pushed(ceiling)
    assert max(_energies(model, free)) > 20 * ceiling
    found = _energies(model, bound)
    assert max(found) <= ceiling * (1 + 1e-4) and max(found) > 0.2 * ceiling
    ends = [float(model.energy(model.batch((0,)), SimState(x, x)).detach()) for x in bound]
    assert max(ends) <= 2 * ceiling * (1 + 1e-4)
    pinned = scene.pinned | ~scene.simulated
    assert torch.equal(bound[:, pinned], scene.means[pinned].expand(31, -1, -1))
    assert torch.equal(pushed(1e9, 10), free[:11])
    dynamics = SceneDynamics(model, 0, energy_ceiling=2 * ceiling)
    gentle = dynamics.rollout(still, 6, forces=lambda n: 0.2 * push if n < 2 else None)
    assert torch.equal(gentle.positions, small.positions)
    limited = []
    for share in (0.01, 1.0):
        stepper = SceneDynamics(model, 0, energy_ceiling=ceiling).stepper(still)
        for _ in range(4):
            stepper.step(share * push)
        limited.append(stepper.limited)
    assert limited[0] == 0 < limited[1] <= 4
