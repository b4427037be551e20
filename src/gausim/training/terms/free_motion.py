"""Penalty on the energy growth of free motion beyond the training frames."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.core import ConfigError, Frame, SimState
from gausim.data.sampler import hash_seed
from gausim.losses.objective import Objective
from gausim.training.contracts import SceneBatch
from gausim.training.graphed import GraphedRollouts
from gausim.training.rollout import after

# Range of the random factor on the motion that continues freely, so that all amplitudes are trained.
SMALLEST, LARGEST = 0.2, 1.5
TINY = 1e-30
# Separates the random numbers of free motion from the others of a step.
FREE_MOTION = 1


def energy_growth(
    model: Any,
    batch: SceneBatch,
    state: SimState,
    frames: int,
    stretch: int,
    draws: torch.Generator,
    graphs: GraphedRollouts,
) -> Iterator[Float[Tensor, " S"]]:
    """Continues the motion of a batch without forces and computes the growth of its energy.

    The energy of a vibration in the template's terms is not constant from frame to frame, so means over stretches of
    about a period are compared. The motion continues from ``state``, scaled by a random factor, for ``frames`` frames;
    loss gradients stop at the beginning of every ``stretch``. Surroundings are left out. After an explosion nothing
    more is yielded: its loss gradients are not finite. ``graphs`` are the model's.

    Yields:
        max(0, ln E_k / E_{k-1}) of every member, stretch by stretch from the second on; differentiable.
    """
    low, high = math.log(SMALLEST), math.log(LARGEST)
    size = math.exp(low + (high - low) * float(torch.rand((), generator=draws)))
    now, before = (batch.rest + size * (x.detach() - batch.rest) for x in (state.positions, state.previous))
    state = SimState(now, before)
    with torch.no_grad():
        ((_, made),) = graphs.windows(batch, state, stretch, stretch, isolated=True)
        before = _mean_energy(model, batch, state, made)
    state = after(made, state)
    for _, made in graphs.windows(batch, state, frames - stretch, stretch, isolated=True):
        now = _mean_energy(model, batch, state, made)
        if not bool(torch.isfinite(now).all()):
            return  # exploded; loss gradients are not finite (the step's only read that blocks on a GPU)
        yield (now.clamp_min(TINY) / before.clamp_min(TINY)).log().clamp_min(0)
        before, state = now.detach(), after(made, state)


def _mean_energy(model: Any, batch: SceneBatch, state: SimState, made: list[Frame]) -> Float[Tensor, " S"]:
    positions = [state.positions, *(step.positions for step in made)]
    prepared = model.prepare(batch, isolated=True)
    energies = [model.energy(batch, SimState(b, a), prepared) for a, b in zip(positions, positions[1:], strict=False)]
    return torch.stack(energies).mean(0)


class FreeMotion:
    """Loss term of free motion, with its probability, length and weight.

    Attributes:
        weight: weight of the energy growth; 0 for a model without an energy.
    """

    def __init__(self, model: nn.Module, objective: Objective, graphs: GraphedRollouts) -> None:
        knows, weight = bool(getattr(model, "knows_energy", False)), objective.energy.weight
        if weight and not knows:
            name = type(getattr(model, "template", model)).__name__
            raise ConfigError(
                f"loss.energy.weight is {weight}, but {name} knows no energy. Use a template that does "
                "(gausim.models.template.material.MaterialTemplate), or set it to 0 or null."
            )
        self.weight = float(knows) if weight is None else float(weight)
        self._model, self._settings, self._graphs = model, objective.energy, graphs

    def chosen(self, draws: torch.Generator) -> torch.Generator | None:
        """Draws whether this batch has the term; returns its random generator, or None."""
        if self.weight == 0 or float(torch.rand((), generator=draws)) >= self._settings.probability:
            return None
        return torch.Generator().manual_seed(hash_seed(draws.initial_seed(), FREE_MOTION))

    def descend(
        self,
        batch: SceneBatch,
        state: SimState,
        losses: Float[Tensor, " S"],
        count: int,
        draws: torch.Generator,
        backward: Callable[[Tensor], None],
    ) -> Float[Tensor, ""]:
        """Backward pass of the growth, each member's in units of its image loss; returns the mean growth.

        The motion continues from ``state``; ``count`` is the number of the step's sequences over all ranks, and
        ``draws`` is the generator of :meth:`chosen`.
        """
        frames, stretch = self._settings.frames, self._settings.stretch
        total = losses.new_zeros(())
        for growth in energy_growth(self._model, batch, state, frames, stretch, draws, self._graphs):
            if growth.requires_grad:
                backward(self.weight * (losses * growth).sum())
            total += growth.detach().sum() / count
        return total
