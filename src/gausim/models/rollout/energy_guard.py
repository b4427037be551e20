"""No energy without a force, in rollouts: the network's correction is held back where it would add some."""

from __future__ import annotations

from collections import deque

import torch
from torch import Tensor

from gausim.core import SimState, SteppedFrame
from gausim.models.rollout.cuda_graph import StepFunction
from gausim.models.step.prepared import Prepared
from gausim.models.step.simulator import GausSim
from gausim.ops.deformation import polar_rotation

# Parts of a force that are tried where all of it would pass the ceiling.
WEAKER = (0.5, 0.25, 0.125, 0.0625, 0.0)
# Halvings with which a step is cut short: to the thousandth part.
BISECTIONS = 10


class EnergyGuard:
    """Keeps the energy E of a rollout, in the template's terms, below the largest of the last frames.

    Frame by frame the network may give back what it took, move energy between vibrations, or make up for damping; the
    peaks of E over ``frames`` frames can only fall. So a motion that nothing pushes stays bounded for ever, however
    long it is predicted. Where a step would pass the limit it is made again with the part

        s = (limit - E_0) / (E_1 - E_0)

    of the network's output, E_0 and E_1 being the energies with none and all of it. E is convex in the state, so that
    of that part stays below the limit as far as the state is linear in s; where it does not, and where the template
    alone passes the limit (springs beyond the linear are taken explicitly), the template's own step is taken.

    Far beyond the motion that training shows those explicit springs are unstable: what forces have carried there would
    fly apart. A ``ceiling`` ends that. A force that would pass it acts in part only; a step that passes it all the
    same is cut short, to the longest part of it that does not. So forces bend nothing further than that energy does.
    """

    def __init__(self, model: GausSim, prepared: Prepared, step: StepFunction, *, ceiling: float | None = None) -> None:
        """Begins a rollout of a batch of one scene.

        Args:
            model: whose template has an energy, and whose settings say over how many frames the limit looks back.
            prepared: of the batch.
            step: predicts with all of the correction.
            ceiling: the highest energy that is allowed at all; None: whatever forces make of it.
        """
        self._model, self._prepared, self._step = model, prepared, step
        self._last: deque[float] = deque(maxlen=model.rollout.energy_guard_frames)
        self._ceiling = ceiling
        self._made: SteppedFrame | None = None
        self.held, self.limited = 0, 0

    def step(self, state: SimState, force: Tensor | None) -> SteppedFrame:
        """The next frame; the work that a force does raises the limit.

        Counted are those whose correction was held back (:attr:`held`) and those that the ceiling limited, their force
        weakened or the step itself cut short (:attr:`limited`).
        """
        if not self._last:
            self._last.append(self._model.template.headroom * self._energy(state))
        if force is not None:
            pushed = self._model.pushed(self._prepared, state, force)
            work = max(0.0, self._energy(pushed) - self._energy(state))
            self._last = deque((energy + work for energy in self._last), self._last.maxlen)
        result = self._step(state, force)
        energy, limit = self._energy(_after(result, state)), max(self._last)
        if energy > limit:
            result, energy = self._held_back(state, force, energy, limit)
        if self._ceiling is not None and energy > self._ceiling:
            self.limited += 1
            if force is not None:
                result, energy = self._weakened(state, force, self._ceiling)
            if energy > self._ceiling:
                result, energy = self._cut_short(result, state, self._ceiling)
        self._last.append(energy)
        self._made = SteppedFrame(result.positions, result.deformation_gradients, result.rotations)
        return result

    def _weakened(self, state: SimState, force: Tensor, ceiling: float) -> tuple[SteppedFrame, float]:
        """The template's step with the largest part of the force that stays below the ceiling, or none."""
        for scale in WEAKER:
            made, energy = self._corrected(state, scale * force if scale else None, 0.0)
            if energy <= ceiling:
                break
        return made, energy

    def _cut_short(self, made: SteppedFrame, state: SimState, ceiling: float) -> tuple[SteppedFrame, float]:
        """The longest part of a step below the ceiling, by bisection; none where even standing still is above it.

        Below means in motion and if it stopped at once: E looks at the middle of a step, which its end may overtop.
        """
        limit = max(ceiling, self._energy(SimState(state.positions, state.positions)))
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            scale = (low + high) / 2
            x = self._part(made, state, scale).positions
            needed = max(self._energy(SimState(x, state.positions)), self._energy(SimState(x, x)))
            low, high = (scale, high) if needed <= limit else (low, scale)
        part = self._part(made, state, low)
        return part, self._energy(_after(part, state))

    def _part(self, made: SteppedFrame, state: SimState, scale: float) -> SteppedFrame:
        positions = state.positions + scale * (made.positions - state.positions)
        if self._made is None:  # the first step: from G = I
            before = turned = torch.eye(3).to(positions).expand_as(made.deformation_gradients)
        else:
            before, turned = self._made.deformation_gradients, self._made.rotations
        deformation_gradients = before + scale * (made.deformation_gradients - before)
        rotations = polar_rotation(turned + scale * (made.rotations - turned))
        return SteppedFrame(positions, deformation_gradients, rotations)

    def _held_back(
        self, state: SimState, force: Tensor | None, energy: float, limit: float
    ) -> tuple[SteppedFrame, float]:
        self.held += 1
        alone, lowest = self._corrected(state, force, 0.0)
        if lowest >= limit:
            return alone, lowest
        part, found = self._corrected(state, force, (limit - lowest) / (energy - lowest))
        return (part, found) if found <= limit else (alone, lowest)

    def _corrected(self, state: SimState, force: Tensor | None, scale: float) -> tuple[SteppedFrame, float]:
        made = self._model.step(self._prepared.batch, state, force, self._prepared, scale)
        return made, self._energy(_after(made, state))

    def _energy(self, state: SimState) -> float:
        return float(self._model.energy(self._prepared.batch, state, self._prepared))


def _after(step: SteppedFrame, state: SimState) -> SimState:
    return SimState(step.positions, state.positions)
