"""Long rollouts of a trained simulator: ``python -m benchmarks.endurance RUN [FRAMES]``.

Writes ``RUN/evaluation/endurance.json``: energy and distance from rest of every object's first sequence without forces,
and under random pushes in the first 240 frames.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.compose.build import load_run
from gausim.compose.predict import RunObject, run_objects
from gausim.core import ConfigError, Hands, SimState
from gausim.metrics.motion import motion_energy
from gausim.models.rollout.dynamics import SceneDynamics
from gausim.models.step.simulator import GausSim

# Frames over which a figure is averaged.
WINDOW = 20
# A push: frames from start to start, its length in frames, its radius and its shift per frame [diagonals].
PUSH_EVERY, PUSH_FRAMES, PUSH_REACH, PUSH_SHIFT = 24, 3, 0.15, 0.002
# Duration of the random pushes [frames].
PUSHED_FRAMES = 240


@dataclass(frozen=True, eq=False)
class RandomPushes:
    """Pushes at random places in random directions, reproducible by the seed."""

    rest: Float[Tensor, "K 3"]  # rest positions [scene units]
    mass: Float[Tensor, " K"]
    free: Bool[Tensor, " K"]  # which kernels can be pushed
    diagonal: float  # of the scene [scene units]
    fps: float
    frames: int  # pushes begin before this frame
    seed: int = 0

    def __call__(self, step: int) -> Float[Tensor, "K 3"] | None:
        """Force on every kernel [mass scene units / s^2], which shifts it by f dt^2 / (2 m) (METHOD section 6)."""
        number, age = divmod(step, PUSH_EVERY)
        if step >= self.frames or age >= PUSH_FRAMES:
            return None
        draws = torch.Generator().manual_seed(1_000_003 * self.seed + number)
        places = self.free.nonzero()[:, 0]
        centre = self.rest[places[int(torch.randint(len(places), (), generator=draws))]]
        direction = torch.nn.functional.normalize(torch.randn(3, generator=draws), dim=0).to(self.rest)
        distance = (self.rest - centre).norm(dim=-1) / (PUSH_REACH * self.diagonal)
        shift = PUSH_SHIFT * self.diagonal * torch.exp(-0.5 * distance.square())
        return (2 * self.fps**2 * self.mass * shift * self.free)[:, None] * direction


def endure(
    dynamics: SceneDynamics,
    initial: SimState,
    rest: Float[Tensor, "K 3"],
    diagonal: float,
    frames: int,
    *,
    pushes: RandomPushes | None = None,
    hands: Hands | None = None,
) -> dict[str, Any]:
    """Figures of a long rollout from a state: energy, distance from rest [scene units] and growth.

    ``energy`` is the mean motion energy of every 20 frames [diagonals^2, summed over kernels], ``away`` their mean
    distance of kernels from rest [diagonals], ``peak`` the time of the highest energy [frames], ``growth`` the
    highest energy after the pushes (after the first quarter without pushes) over the highest before, ``late`` the
    energy of the last tenth over the highest of all.

    Raises:
        DivergenceError: a position is not finite; the message names the frame.
    """
    positions = dynamics.rollout(initial, frames, forces=pushes, hands=hands).positions
    energy = _windows(motion_energy(positions).cpu().double().numpy() / diagonal**2)
    away = _windows((positions[1:] - rest).norm(dim=-1).mean(-1).cpu().double().numpy() / diagonal)
    border = max(1, (frames // 4 if pushes is None else pushes.frames + PUSH_EVERY) // WINDOW)
    late = energy[-max(1, len(energy) // 10) :].mean()
    top = max(float(energy.max()), np.finfo(float).tiny)
    return {
        "window": WINDOW,
        "energy": energy.tolist(),
        "away": away.tolist(),
        "peak": int(energy.argmax()) * WINDOW,
        "growth": float(energy[border:].max(initial=0.0) / max(float(energy[:border].max()), np.finfo(float).tiny)),
        "late": float(late / top),
    }


def _windows(values: np.ndarray) -> np.ndarray:
    count = len(values) // WINDOW
    return values[: count * WINDOW].reshape(count, WINDOW).mean(1)


def endurance(item: RunObject, frames: int) -> dict[str, Any]:
    """Long rollouts of an object: its first sequence without forces, and random pushes from rest."""
    run, module = item.run, cast(Any, item.run.module)
    if not isinstance(module.model, GausSim):
        raise ConfigError(f"{run.run_dir}: {module.method_name} takes no forces. Take a run of a simulator.")
    scene, dynamics = item.scene.to(run.device), SceneDynamics(module.model, item.scene_id)
    first, hands = module.initial_states.state(item.first_sequence).detach(), module.method.hands(item.first_sequence)
    free = scene.simulated & ~scene.pinned
    pushes = RandomPushes(scene.means, dynamics.masses, free, scene.diagonal, item.data.fps, PUSHED_FRAMES)
    still = SimState(scene.means, scene.means)
    return {
        "free": endure(dynamics, first, scene.means, scene.diagonal, frames, hands=hands),
        "pushed": endure(dynamics, still, scene.means, scene.diagonal, frames, pushes=pushes),
    }


@torch.no_grad()
def main(argv: Sequence[str]) -> int:
    """Measures, prints and writes the rollouts of a run."""
    run, frames = load_run(argv[0], device="auto"), max(300, int(argv[1]) if len(argv) > 1 else 1000)
    found = {item.data.name: endurance(item, frames) for item in run_objects(run)}
    path = Path(argv[0]) / "evaluation" / "endurance.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(found, indent=1) + "\n")
    for name, rollouts in found.items():
        for kind, rollout in rollouts.items():
            growth, late = rollout["growth"], rollout["late"]
            print(f"{name}, {kind}: highest energy later over before {growth:.3f}, of the last tenth {late:.2g}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
