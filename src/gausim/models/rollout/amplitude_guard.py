"""Amplitude guard of rollouts of a taught network without an energy: scales down what grows without a force."""

import math
from collections import deque
from dataclasses import replace

import torch
from torch import Tensor

from gausim.core import Frame, SimState
from gausim.models.rollout.cuda_graph import StepFunction
from gausim.models.step.prepared import Prepared
from gausim.models.step.simulator import GausSim
from gausim.ops.deformation import polar_rotation

# Part of the energy that a body at least loses in a frame, so that motion dies away whatever was measured. The first
# limit over the energy of the initial state: the oscillator knows the energy of a body only roughly.
LOSS, HEADROOM = 0.005, 1.5


class AmplitudeGuard:
    """Keeps the motion of a body from growing where nothing drives it.

    The rest state as template has no energy. That of an oscillator takes its place, with the mean angular frequency w
    of the tracked motion [1 / frame] and the part of its energy that it loses in a frame. Of units c with
    displacements u from rest it is

        E = sum_c m_c (|u_t - u_{t-1}|^2 + w^2 |(u_t + u_{t-1}) / 2|^2)

    E_t is at most the largest of the last frames, less the loss per frame since, at least :data:`LOSS`. Where the
    network exceeds this, the displacements at t and t - 1 are scaled by the root of the ratio. Small motions of an
    elastic body add up, so the scaled motion is one of the body, too.
    """

    limited = 0  # no ceiling reduces forces

    def __init__(self, model: GausSim, prepared: Prepared, step: StepFunction, oscillator: Tensor) -> None:
        """Begins a rollout of a batch of one scene.

        Args:
            model: the simulator; its rollout settings give the number of the last frames.
            prepared: constants of the batch.
            step: predicts a frame.
            oscillator: w [1 / frame] and the loss (2,) (:meth:`gausim.models.template.template.Template.oscillator`).
        """
        self._model, self._prepared, self._step = model, prepared, step
        self._frequency, loss = oscillator.tolist()
        self._left = 1 - max(LOSS, loss)  # of the energy, after a frame
        self._last: deque[float] = deque(maxlen=model.rollout.energy_guard_frames)

    def step(self, state: SimState, force: Tensor | None) -> Frame:
        """The next frame; the work done by a force raises the limit."""
        if not self._last:
            self._last.append(HEADROOM * self._energy(state))
        work = 0.0
        if force is not None:
            # A shift of x_t within its frame adds twice as much to the velocity.
            shift = self._model.pushed(self._prepared, state, force).positions - state.positions
            faster = SimState(state.positions + 2 * shift, state.previous)
            work = max(0.0, self._energy(faster) - self._energy(state))
        limit = max(self._last) + work
        frame = self._step(state, force)
        energy = self._energy(frame.following(state))
        if energy > limit:
            frame, energy = self._scaled(frame, state, math.sqrt(limit / energy)), limit
        every = [*(before + work for before in self._last), energy]
        self._last = deque((self._left * before for before in every), self._last.maxlen)
        return frame

    def _scaled(self, frame: Frame, state: SimState, scale: float) -> Frame:
        rest, one, after = self._prepared.batch.rest, torch.eye(3).to(frame.positions), frame.following(state)
        now, before, *older = (rest + scale * (x - rest) for x in (after.positions, after.previous, *after.older))
        gradients, rotations = (one + scale * (x - one) for x in (frame.deformation_gradients, frame.rotations))
        made = replace(frame, positions=now, deformation_gradients=gradients, rotations=polar_rotation(rotations))
        return replace(made, state=SimState(now, before, tuple(older)))

    def _energy(self, state: SimState) -> float:
        now, before = (self._prepared.mean(x) - self._prepared.rest for x in (state.positions, state.previous))
        squares = (now - before).square() + (self._frequency * (now + before) / 2).square()
        return float(self._prepared.levels[-1].mass @ squares.sum(-1))
