"""No energy without a force: a regulariser of free motion beyond the frames that training sees."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import SimState
from gausim.engine.contracts import Energetic, SceneBatch, Simulator, Step
from gausim.engine.rollout import windows

# The motion that goes on is made smaller or larger by up to these factors, so that no size of motion is left out.
SMALLEST, LARGEST = 0.2, 1.5
TINY = 1e-30


def energy_growth(
    model: Simulator, batch: SceneBatch, state: SimState, frames: int, stretch: int, draws: torch.Generator
) -> Iterator[Float[Tensor, " S"]]:
    """Lets the motion of a batch go on freely and says by how much its energy grows.

    The energy of a vibration in the template's terms is not constant from frame to frame, so the means over stretches
    of about a period are compared.

    Args:
        model: has an energy (:meth:`gausim.engine.contracts.Energetic.energy`).
        batch: the disjoint graph.
        state: from which the motion goes on, at a random size.
        frames: how far.
        stretch: frames per stretch; gradients stop at its beginning.
        draws: the random size.

    A motion that explodes ends without a word: its gradients are not finite.

    Yields:
        max(0, ln E_k / E_{k-1}) of every member, stretch by stretch from the second on; differentiable.
    """
    low, high = math.log(SMALLEST), math.log(LARGEST)
    size = math.exp(low + (high - low) * float(torch.rand((), generator=draws)))
    state = SimState(
        *(batch.rest + size * (x - batch.rest) for x in (state.positions.detach(), state.previous.detach()))
    )
    with torch.no_grad():
        ((_, made),) = windows(model, batch, state, stretch, stretch)
        before = _mean_energy(model, batch, state, made)
    state = _last(state, made)
    for _, made in windows(model, batch, state, frames - stretch, stretch):
        now = _mean_energy(model, batch, state, made)
        if not bool(torch.isfinite(now).all()):
            return  # exploded; nothing can be learned from it
        yield (now.clamp_min(TINY) / before.clamp_min(TINY)).log().clamp_min(0)
        before, state = now.detach(), _last(state, made)


def _last(state: SimState, made: list[Step]) -> SimState:
    previous = made[-2].positions if len(made) > 1 else state.positions
    return SimState(made[-1].positions, previous).detach()


def _mean_energy(model: Simulator, batch: SceneBatch, state: SimState, made: list[Step]) -> Float[Tensor, " S"]:
    assert isinstance(model, Energetic)
    positions = [state.positions, *(step.positions for step in made)]
    energies = [model.energy(batch, SimState(b, a)) for a, b in zip(positions, positions[1:], strict=False)]
    return torch.stack(energies).mean(0)
