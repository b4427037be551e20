"""No energy without a force, in rollouts: the network's correction is held back where it would add some."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from torch import Tensor

from gausim.core import SimState
from gausim.models.cuda_graph import Predicted, StepFunction
from gausim.models.prepared import Prepared

if TYPE_CHECKING:
    from gausim.models.simulator import GausSim


class EnergyGuard:
    """Keeps the energy E of a rollout, in the template's terms, below the largest of the last frames.

    Frame by frame the network may give back what it took, move energy between vibrations, or make up for damping; the
    peaks of E over ``frames`` frames can only fall. So a motion that nothing pushes stays bounded for ever, however
    long it is predicted. Where a step would pass the limit it is made again with the share

        s = (limit - E_0) / (E_1 - E_0)

    of the network's output, E_0 and E_1 being the energies with none and all of it. E is convex in the state, so that
    of the share stays below the limit as far as the state is linear in s; where it does not, and where the template
    alone passes the limit (its springs beyond the linear are taken explicitly), the template's own step is taken.
    """

    def __init__(self, model: GausSim, prepared: Prepared, frames: int) -> None:
        """Begins a rollout of a batch of one scene.

        Args:
            model: whose template has an energy.
            prepared: of the batch.
            frames: over which the limit looks back; about a period of the slowest vibration.
        """
        self._model, self._prepared = model, prepared
        self._last: deque[float] = deque(maxlen=frames)
        self.held = 0

    def step(self, step: StepFunction, state: SimState, force: Tensor | None) -> Predicted:
        """The next frame; :attr:`held` counts those whose correction was held back.

        Args:
            step: predicts with all of the correction.
            state: positions and previous positions of the kernels [scene units].
            force: as of :meth:`gausim.models.simulator.GausSim.step`; the work it does raises the limit.
        """
        if not self._last:
            self._last.append(self._energy(state))
        if force is not None:
            pushed = self._model.pushed(self._prepared, state, force)
            work = max(0.0, self._energy(pushed) - self._energy(state))
            self._last = deque((energy + work for energy in self._last), self._last.maxlen)
        result = step(state, force)
        energy, limit = self._energy(_after(result, state)), max(self._last)
        if energy > limit:
            result, energy = self._held_back(state, force, energy, limit)
        self._last.append(energy)
        return result

    def _held_back(self, state: SimState, force: Tensor | None, energy: float, limit: float) -> tuple[Predicted, float]:
        self.held += 1
        alone, lowest = self._shared(state, force, 0.0)
        if lowest >= limit:
            return alone, lowest
        part, found = self._shared(state, force, (limit - lowest) / (energy - lowest))
        return (part, found) if found <= limit else (alone, lowest)

    def _shared(self, state: SimState, force: Tensor | None, share: float) -> tuple[Predicted, float]:
        made = self._model.step(self._prepared.batch, state, force, self._prepared, share)
        return made, self._energy(_after(made, state))

    def _energy(self, state: SimState) -> float:
        return float(self._model.energy(self._prepared.batch, state, self._prepared))


def _after(step: Predicted, state: SimState) -> SimState:
    return SimState(step.positions, state.positions)
