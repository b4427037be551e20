"""Static loss: a body at rest stays at rest, and its image is frame 0 (METHOD section 4)."""

import torch

from gausim.core import Frame, SimState
from gausim.losses.objective import static_loss
from gausim.training.contracts import SceneBatch, Simulator
from gausim.training.rollout import States
from gausim.training.terms.term import StepInputs


def rest_term(step: StepInputs) -> None:
    """Loss of one step from the rest state, in randomly drawn batches: ||x_1 - X||^2 in diagonals, and the image loss.

    One rank computes a scene's static loss.
    """
    chance = step.objective.static_chance(step.whole[0].steps)
    if float(torch.rand((), generator=step.draws)) >= chance:
        return
    if step.objective.rest_image_weight and step.samples:
        batch = step.simulator.batch([s.scene_id for s in step.samples])
        comparison = step.images.comparison(step.samples, batch, slice(0, 1))
        losses, _ = comparison(States.of([_step(step.simulator, batch)]), 0)
        step.backward(step.objective.rest_image_weight / len(step.whole) * losses.sum())
    scene_ids = sorted({s.scene_id for s in step.whole})
    own = scene_ids[step.ranks.rank :: step.ranks.size]
    if not own:
        return
    batch = step.simulator.batch(own)
    made = _step(step.simulator, batch)
    diagonal = torch.cat([batch.rest.new_full((len(batch.rest[m.kernels]), 1), step.diagonals[m.scene_id])
                          for m in batch.members])  # fmt: skip
    loss = static_loss(made.positions, batch.rest, diagonal) / len(scene_ids)
    step.backward(step.objective.static_weight * loss)
    step.statistics.static = loss.detach()


def _step(simulator: Simulator, batch: SceneBatch) -> Frame:
    """One step from rest, without surroundings: what falls does not stay."""
    still = SimState(batch.rest, batch.rest)
    made: Frame = simulator.step(batch, still, prepared=simulator.prepare(batch, isolated=True))
    return made
