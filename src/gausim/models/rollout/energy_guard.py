"""Energy guard of rollouts: scales the network's correction down where it would add energy without a force."""

from collections import deque

import torch
from torch import Tensor

from gausim.core import Frame, SimState
from gausim.models.rollout.cuda_graph import StepFunction
from gausim.models.step.latest import Latest
from gausim.models.step.prepared import Prepared
from gausim.models.step.simulator import GausSim
from gausim.ops.deformation import polar_rotation

# Fractions of a force that are tried in turn where the whole force would exceed the ceiling.
WEAKER = (0.5, 0.25, 0.125, 0.0625, 0.0)
# Bisections for the fraction of a shortened step: an accuracy of 1/1024.
BISECTIONS = 10


class EnergyGuard:
    """Keeps the energy E of a rollout, in the template's terms, below what damping leaves of that of the last frames.

    Since some frame of the last ``energy_guard_frames`` the network must not have done work: E_t is at most the largest
    of E_i minus what the template's damping has taken since frame i. Within that window the network may return energy
    that it removed, or exchange it between modes; motion without forces dies away as the damping says. A step that
    would exceed the limit is repeated with the correction scale

        s = (limit - E_0) / (E_1 - E_0)

    on the network's output, where E_0 and E_1 are the energies at s = 0 and s = 1. E is convex in the state, so the
    repeated step stays below the limit as far as the state is linear in s. If it does not, the step of the template
    alone is taken, which adds no energy.

    Far outside the motion seen in training neither template nor network means anything, and strong forces could lead
    there. A ``ceiling`` prevents this: a force that would exceed it is reduced to a fraction, and a step that still
    exceeds it is shortened to the longest fraction below it. The ceiling thus bounds the deformation that forces can
    cause: no frame has more than twice its energy.
    """

    def __init__(self, model: GausSim, prepared: Prepared, step: StepFunction, *, ceiling: float | None = None) -> None:
        """Begins a rollout of a batch of one scene.

        Args:
            model: a model whose template has an energy; its rollout settings give the number of frames of the window.
            prepared: constants of the batch.
            step: predicts with the full correction.
            ceiling: highest energy allowed, forces included; None: no ceiling.
        """
        self._model, self._prepared, self._step = model, prepared, step
        self._last: deque[float] = deque(maxlen=model.rollout.energy_guard_frames)
        self._ceiling = ceiling
        self._energies: Latest[float] = Latest()
        self._last_frame: Frame | None = None
        self.held, self.limited = 0, 0

    def step(self, state: SimState, force: Tensor | None) -> Frame:
        """The next frame; the work done by a force raises the limit.

        :attr:`held` counts the frames whose correction was scaled down, :attr:`limited` those whose force or step the
        ceiling reduced.
        """
        if not self._last:
            self._last.append(self._model.template.headroom * self._energy(state))
        pushed = state if force is None else self._model.pushed(self._prepared, state, force)
        work = max(0.0, self._energy(pushed) - self._energy(state)) if force is not None else 0.0
        self._last = deque((energy + work for energy in self._last), self._last.maxlen)
        result = self._step(pushed, None)
        energy, limit = self._energy(result.following(state)), max(self._last)
        if energy > limit:
            result, energy = self._held_back(pushed, energy, limit)
        if self._ceiling is not None and not self._is_below(result.positions, state, self._ceiling):
            self.limited += 1
            result, energy = self._limited(result, state, force, self._ceiling)
        lost = float(self._model.dissipated(self._prepared, result.following(state), state.previous))
        self._last = deque((before - lost for before in self._last), self._last.maxlen)
        self._last.append(energy)
        self._last_frame = result
        return result

    def _is_below(self, x: Tensor, state: SimState, ceiling: float, standing: float = 0.0) -> bool:
        """Whether a step to x is below the ceiling, and below twice the ceiling at rest at its end.

        E is evaluated at the midpoint of a step; fast modes have more potential energy at its end. ``standing`` is the
        energy of standing still; what exceeds the ceiling but not that is below, too.
        """
        if self._energy(SimState(x, state.positions)) > max(ceiling, standing):
            return False
        return self._energy(SimState(x, x)) <= max(2 * ceiling, standing)

    def _limited(self, frame: Frame, state: SimState, force: Tensor | None, ceiling: float) -> tuple[Frame, float]:
        """The template's step with the largest tried fraction of the force below the ceiling, or a shortened step."""
        if force is not None:
            for scale in WEAKER:
                frame, energy = self._corrected(state, scale * force if scale else None, 0.0)
                if self._is_below(frame.positions, state, ceiling):
                    return frame, energy
        return self._cut_short(frame, state, ceiling)

    def _cut_short(self, frame: Frame, state: SimState, ceiling: float) -> tuple[Frame, float]:
        """The longest fraction of a step below the ceiling, by bisection."""
        standing = self._energy(SimState(state.positions, state.positions))
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            scale = (low + high) / 2
            below = self._is_below(self._part(frame, state, scale).positions, state, ceiling, standing)
            low, high = (scale, high) if below else (low, scale)
        part = self._part(frame, state, low)
        return part, self._energy(part.following(state))

    def _part(self, frame: Frame, state: SimState, scale: float) -> Frame:
        positions = state.positions + scale * (frame.positions - state.positions)
        if self._last_frame is None:  # the first step: from G = I
            before = turned = torch.eye(3).to(positions).expand_as(frame.deformation_gradients)
        else:
            before, turned = self._last_frame.deformation_gradients, self._last_frame.rotations
        deformation_gradients = before + scale * (frame.deformation_gradients - before)
        rotations = polar_rotation(turned + scale * (frame.rotations - turned))
        return Frame(positions, deformation_gradients, rotations)

    def _held_back(self, state: SimState, energy: float, limit: float) -> tuple[Frame, float]:
        self.held += 1
        alone, lowest = self._corrected(state, None, 0.0)
        if lowest >= limit:
            return alone, lowest
        part, reached = self._corrected(state, None, (limit - lowest) / (energy - lowest))
        return (part, reached) if reached <= limit else (alone, lowest)

    def _corrected(self, state: SimState, force: Tensor | None, scale: float) -> tuple[Frame, float]:
        frame = self._model.step(self._prepared.batch, state, force, self._prepared, scale)
        return frame, self._energy(frame.following(state))

    def _energy(self, state: SimState) -> float:
        states = state.positions, state.previous
        return self._energies.of(states, lambda: float(self._model.energy(self._prepared.batch, state, self._prepared)))
