"""Rollouts of one scene by the simulator: :class:`gausim.core.Dynamics` without gradients."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Forces, SimState, Trajectory
from gausim.models.cuda_graph import GraphedStep, Predicted, StepFunction
from gausim.models.passive import EnergyGuard
from gausim.models.prepared import Prepared
from gausim.models.watch import Watch

if TYPE_CHECKING:
    from gausim.models.simulator import GausSim


class SceneDynamics:
    """Rolls one scene of a :class:`GausSim` out, without gradients and in evaluation mode."""

    def __init__(self, model: GausSim, scene_id: int) -> None:
        """Binds ``model`` to its scene number ``scene_id``."""
        self.model, self.scene_id = model, scene_id

    @property
    @torch.no_grad()
    def masses(self) -> Float[Tensor, " K"]:
        """Mass of every kernel of the scene, up to a common factor; 0 for those never simulated."""
        scene, hierarchy = self.model.scenes[self.scene_id], self.model.hierarchies[self.scene_id]
        own, _ = self.model.masses(self.model.batch((self.scene_id,)))
        return own.new_zeros(scene.count).index_copy(0, hierarchy.kernels.to(own.device), own)

    @torch.no_grad()
    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """Predicts ``steps`` frames; frame 0 is the initial state with identity gradients (METHOD: the rest state).

        Raises:
            DivergenceError: a position or force is not finite; the message names the frame.
        """
        was_training = self.model.training
        self.model.eval()
        try:
            return self._rollout(initial, steps, forces)
        finally:
            self.model.train(was_training)

    def _rollout(self, initial: SimState, steps: int, forces: Forces | None) -> Trajectory:
        batch = self.model.batch((self.scene_id,))
        prepared = self.model.prepare(batch)
        member = batch.members[0]
        units = member.units.stop - member.units.start
        identity = torch.eye(3).to(initial.positions).expand(units, 3, 3)
        positions, gradients, rotations = [initial.positions], [identity], [identity]
        state = initial
        watch = Watch(self.model.scenes[self.scene_id].name, steps, initial.positions.device)
        watch.positions(0, initial.positions, initial.previous)
        step, guard = self._step(prepared), self._guard(prepared)
        for number in range(steps):
            force = forces(number) if forces is not None else None
            if force is not None:
                watch.forces(number, force)
            watch.ask(number)
            result = step(state, force) if guard is None else guard.step(step, state, force)
            watch.positions(number + 1, result.positions)
            state = SimState(result.positions, state.positions)
            positions.append(result.positions)
            gradients.append(result.gradients)
            rotations.append(result.rotations)
        watch.ask(steps, now=True)
        return Trajectory(
            torch.stack(positions),
            torch.stack(gradients),
            torch.stack(rotations),
            member.unit_of_kernel,
            self.model.fps[self.scene_id],
        )

    def _step(self, prepared: Prepared) -> StepFunction:
        def step(state: SimState, force: Tensor | None) -> Predicted:
            return self.model.step(prepared.batch, state, force, prepared)

        rest = prepared.batch.rest
        if self.model.cuda_graph and rest.device.type == "cuda":
            return GraphedStep(step, rest)
        return step

    def _guard(self, prepared: Prepared) -> EnergyGuard | None:
        if not (self.model.passive_frames and self.model.knows_energy):
            return None
        return EnergyGuard(self.model, prepared, self.model.passive_frames)
