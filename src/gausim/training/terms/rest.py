"""Static loss: a body at rest stays at rest, and its image is frame 0 (METHOD section 4)."""

from __future__ import annotations

import torch

from gausim.core import SimState
from gausim.losses.static import static_loss
from gausim.training.contracts import SceneBatch, Simulator, Step
from gausim.training.rollout import States
from gausim.training.terms.term import StepInputs


class RestTerm:
    """Loss of one step from the rest state, in some batches: ||x_1 - X||^2 in diagonals, and the image loss."""

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator

    def descend(self, step: StepInputs) -> None:
        """Backward pass of both parts, in randomly drawn steps; one rank computes a scene's static loss."""
        chance = step.objective.static_chance(step.whole[0].steps)
        if float(torch.rand((), generator=step.draws)) >= chance:
            return
        if step.objective.rest_image_weight and step.samples:
            self._descend_image(step)
        scene_ids = sorted({s.scene_id for s in step.whole})
        own = scene_ids[step.ranks.rank :: step.ranks.size]
        if not own:
            return
        batch = self._simulator.batch(own)
        made = self._step(batch)
        diagonal = torch.cat([batch.rest.new_full((len(batch.rest[m.kernels]), 1), step.diagonals[m.scene_id])
                              for m in batch.members])  # fmt: skip
        loss = static_loss(made.positions, batch.rest, diagonal) / len(scene_ids)
        step.backward(step.objective.static_weight * loss)
        step.statistics.static = loss.detach()

    def _step(self, batch: SceneBatch) -> Step:
        """One step from rest, without surroundings: what falls does not stay."""
        still = SimState(batch.rest, batch.rest)
        made: Step = self._simulator.step(batch, still, prepared=self._simulator.prepare(batch, isolated=True))
        return made

    def _descend_image(self, step: StepInputs) -> None:
        batch = self._simulator.batch([s.scene_id for s in step.samples])
        made = self._step(batch)
        losses, _ = step.images.at_rest(step.samples, batch)(States.of([made]), 0)
        step.backward(step.objective.rest_image_weight / len(step.whole) * losses.sum())
