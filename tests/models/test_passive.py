"""The guard of rollouts: the network cannot feed free motion, and where it does not try to nothing changes."""

from dataclasses import replace
from functools import partial

import torch
from helpers.bodies import make_model, make_scene, make_state

from gausim.core import GaussianScene, SimState
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.rollout.energy_guard import EnergyGuard
from gausim.models.step.simulator import GausSim
from gausim.models.template.elastic import ElasticTemplate

FRAMES = 10


def _model(scene: GaussianScene, *, frames: int = FRAMES, scale: float = 0.05) -> GausSim:
    """A network with random weights of a size that feeds the motion of an elastic template."""
    template = partial(ElasticTemplate, modes=8, geometric=1.0)
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


def test_a_ceiling_bounds_what_forces_do() -> None:
    """A strong steady force throws the object away without it."""
    scene = make_scene()
    model = _model(scene, scale=0.002)
    still = SimState(scene.means, scene.means)
    push = 60.0 * SceneDynamics(model).masses[:, None] * torch.tensor([0.3, 1.0, 0.2])
    small = SceneDynamics(model).rollout(still, 6, forces=lambda n: 0.2 * push if n < 2 else None)
    ceiling = max(_energies(model, small.positions))

    def pushed(energy_ceiling: float | None) -> torch.Tensor:
        dynamics = SceneDynamics(model, 0, energy_ceiling=energy_ceiling)
        return dynamics.rollout(still, 80, forces=lambda _: push).positions

    free, bound = pushed(None), pushed(ceiling)
    assert max(_energies(model, free)) > 20 * ceiling
    found = _energies(model, bound)
    assert max(found) <= ceiling * (1 + 1e-4) and max(found) > 0.2 * ceiling
    ends = [float(model.energy(model.batch((0,)), SimState(x, x)).detach()) for x in bound]
    assert max(ends) <= 2 * ceiling * (1 + 1e-4)
    pinned = scene.pinned | ~scene.simulated
    assert torch.equal(bound[:, pinned], scene.means[pinned].expand(81, -1, -1))
    assert torch.equal(pushed(1e9), free)
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
