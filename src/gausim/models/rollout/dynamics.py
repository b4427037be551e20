"""Rollouts of one scene by the simulator: :class:`gausim.core.Steppable` without gradients."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Forces, SimState, Trajectory, roll_out
from gausim.models.rollout.stepper import SceneStepper
from gausim.models.step.simulator import GausSim
from gausim.nn.mode import evaluating


class SceneDynamics:
    """Rolls one scene of a :class:`GausSim` out, without gradients and in evaluation mode."""

    def __init__(self, model: GausSim, scene_id: int = 0, *, energy_ceiling: float | None = None) -> None:
        """Binds ``model`` to its scene number ``scene_id``; the ceiling is one of :class:`SceneStepper`."""
        self.model, self.scene_id, self.energy_ceiling = model, scene_id, energy_ceiling

    @property
    @torch.no_grad()
    def masses(self) -> Float[Tensor, " K"]:
        """Mass of every kernel of the scene, up to a common factor; 0 for those never simulated."""
        scene, hierarchy = self.model.scenes[self.scene_id], self.model.hierarchies[self.scene_id]
        own, _ = self.model.masses(self.model.batch((self.scene_id,)))
        return own.new_zeros(scene.count).index_copy(0, hierarchy.kernels.to(own.device), own)

    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """Predicts ``steps`` frames; frame 0 is the initial state with identity gradients (METHOD: the rest state).

        Raises:
            DivergenceError: a position or force is not finite; the message names the frame.
        """
        with evaluating(self.model):
            return roll_out(self.stepper(initial), steps, forces)

    def stepper(self, initial: SimState) -> SceneStepper:
        """Begins at a state; every step is one of :meth:`rollout`."""
        return SceneStepper(self.model, self.scene_id, initial, energy_ceiling=self.energy_ceiling)
