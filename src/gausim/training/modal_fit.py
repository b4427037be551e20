"""Fits of a template to known motion in modal coordinates: a training of seconds, without network and images.

Rollouts z_{t+1} = after(z_t, z_{t-1}) of the template alone are compared with the known coordinates z* of each frame,

    sum_t |z_t - z*_t|^2 / size^2,    size^2 = mean_t |z*_t|^2 of the sequence,

relative to the reference of bodies in hands, whose acceleration is a load,
with T growing from 2 to its longest in a first part and rates that fall as a half-cosine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gausim.models.step.scene_model import SceneModel
from gausim.models.template.modal import ModalScene, Solved
from gausim.nn.schedules import CosineSchedule
from gausim.training.optimizers import OptimizerSettings, set_rates

# Predicted frames in the first update.
SHORTEST = 2
# Steps of rollouts, by frame.
Steps = dict[int, Solved]
FALLING = CosineSchedule(warmup=0.0)


@dataclass(frozen=True, eq=False)
class KnownMotion:
    """Beginnings and continuations of B rollouts in modal coordinates."""

    size: Float[Tensor, " B"]  # root mean square of the sequence
    before: Float[Tensor, "B M"]
    now: Float[Tensor, "B M"]
    after: Float[Tensor, "T B M"]
    load: Float[Tensor, "T B N 12"] | None = None  # of the units, as in UnitMotion

    def distances(self, part: ModalScene, kept: Steps | None = None) -> Iterator[Float[Tensor, " B"]]:
        """Squared distances of the rollouts of a template from the motion, in squared sizes, frame by frame.

        ``kept`` are the steps of rollouts that were nearly the same; they are renewed.
        """
        before, now, kept = self.before, self.now, {} if kept is None else kept
        for frame, true in enumerate(self.after):
            load = None if self.load is None else self.load[frame]
            step = part.solve(now, before, load, kept.get(frame))
            if bool(step.after.isfinite().all()):
                kept[frame] = Solved(step.after.detach(), step.bend, step.inverse)
            before, now = now, step.after
            yield (now - true).square().sum(-1) / self.size.square()

    def error(self, part: ModalScene) -> Float[Tensor, ""]:
        """Mean distance of the rollouts of a template from the motion, in sizes; infinite where it is not finite."""
        return torch.stack([d.sqrt().mean() for d in self.distances(part)]).sum().nan_to_num(torch.inf)


def size_of(z: Float[Tensor, "S F M"]) -> Float[Tensor, " S"]:
    """Root mean square of the coordinates of sequences, never zero."""
    return z.square().sum(-1).mean(1).sqrt().clamp_min(torch.finfo(z.dtype).tiny ** 0.5)


def fit(
    model: SceneModel,
    motions: Sequence[tuple[int, Callable[[int], KnownMotion]]],
    settings: OptimizerSettings,
    groups: dict[str, list[nn.Parameter]],
    *,
    longest: int,
    updates: int,
    growing: float = 0.5,
) -> Iterator[float]:
    """Fits parameters of a model to known motion; yields the loss of every update.

    An update may lead far astray. So the parameters are in the end those of the least loss at the largest T, which is
    what the last update yields.

    Args:
        model: its template has modes.
        motions: for some scenes, by their numbers, the known motion for a given T; it may depend on parameters.
        settings: rates of the groups at the beginning.
        groups: the parameters, without the network's.
        longest: largest T.
        updates: number of updates.
        growing: fraction of the updates over which T grows to its largest.
    """
    trained = {name: [p for p in own if p.requires_grad] for name, own in groups.items()}
    weights = [p for own in trained.values() for p in own]
    optimizer, least, kept = settings.build(trained), math.inf, [p.detach().clone() for p in weights]
    kept_steps: dict[int, Steps] = {}
    last: dict[int, Tensor] = {}
    for update in range(updates):
        steps = min(longest, SHORTEST + int((longest - SHORTEST) * update / updates / growing))
        falling = FALLING.factor(update, updates)
        set_rates(optimizer, lambda name, factor=falling: factor)  # type: ignore[misc]
        optimizer.zero_grad(set_to_none=True)
        total = 0.0
        for scene_id, known in motions:
            motion, part = known(steps), model.modal_scene(scene_id)
            if scene_id not in last or not torch.equal(last[scene_id], motion.after[0]):  # of other rollouts
                kept_steps[scene_id], last[scene_id] = {}, motion.after[0]
            loss = torch.stack([d.mean() for d in motion.distances(part, kept_steps[scene_id])]).mean() / len(motions)
            if bool(torch.isfinite(loss)):
                loss.backward()
            total += float(loss.detach())
        if (steps == longest or update == updates - 1) and total < least:
            least, kept = total, [p.detach().clone() for p in weights]
        if update < updates - 1:
            settings.clip(optimizer)
            optimizer.step()
            yield total
    with torch.no_grad():
        for weight, value in zip(weights, kept, strict=True):
            weight.copy_(value)
    yield least
