"""A scan for the even material of bodies of which some frames are known: the start of its fit by descent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.data.pretraining import BodyData, CorpusDataModule
from gausim.models.hierarchy.batch import SceneBatch
from gausim.models.hierarchy.units import fixed_units
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import MaterialTemplate, PreparedMaterial

# Candidates of attributes 0 and 1, logarithms of stiffness and damping over the reference's; they are scanned in turn.
CANDIDATES = torch.linspace(-3.5, 3.5, 15), torch.linspace(-3, 4, 8)
MOST_TURNS = 8
# Most steps of the compared rollouts, and frames between their beginnings.
STEPS, APART = 4, 2


@torch.no_grad()
def find_materials(model: GausSim, data: CorpusDataModule) -> None:
    """Sets attributes 0 and 1 of every body to the even material that explains its seen frames best.

    The loss of a fit by descent has many minima in a stiffness or damping that is several times too large or too small.
    A scan of these two numbers finds where to begin. Candidates are compared by rollouts of the template alone.
    """
    for scene_id, item in enumerate(cast("list[BodyData]", data.objects)):
        batch = model.batch((scene_id,))
        mass, _ = model.masses(batch)
        attributes, motion = model.attributes[scene_id].data, seen_motion(model, batch, item)
        unchanged, turn = 0, 0
        while unchanged < len(CANDIDATES) and turn < MOST_TURNS:
            number, errors = turn % len(CANDIDATES), []
            before = attributes[0, number].clone()
            for value in CANDIDATES[number]:
                attributes[:, number] = value
                errors.append(motion.error(_part(model, batch, mass, item.fps)))
            attributes[:, number] = CANDIDATES[number][int(torch.stack(errors).argmin())]
            unchanged, turn = unchanged + 1 if attributes[0, number] == before else 0, turn + 1


@dataclass(frozen=True, eq=False)
class SeenMotion:
    """Beginnings and continuations of B rollouts in modal coordinates."""

    size: Float[Tensor, " B"]  # root mean square of the sequence
    before: Float[Tensor, "B M"]
    now: Float[Tensor, "B M"]
    after: Float[Tensor, "T B M"]

    def error(self, part: PreparedMaterial) -> Float[Tensor, ""]:
        """Mean distance of the rollouts of a template from the motion, in sizes; infinite where it is not finite."""
        before, now, error = self.before, self.now, self.now.new_zeros(())
        for true in self.after:
            before, now = now, part.after(now, before)
            error = error + ((now - true).norm(dim=-1) / self.size).mean()
        return error.nan_to_num(torch.inf)


def seen_motion(model: GausSim, batch: SceneBatch, item: BodyData) -> SeenMotion:
    """Rollouts from every other seen frame of a body; the frame before the first is known."""
    prepared = model.prepare(batch)
    projection = cast(MaterialTemplate, model.template).body(batch.scene_ids[0]).projection.flatten(0, 1)
    seen, rest = len(item.train_frames), prepared.levels[-1].rest
    known = item.body.positions[:, : seen + 1].to(projection)
    moved = torch.stack([prepared.finest(x) - rest for x in known.flatten(0, 1)]).flatten(1)
    z = (moved @ projection).unflatten(0, known.shape[:2])
    size = z[:, 1:].square().sum(-1).mean(1).sqrt().clamp_min(torch.finfo(z.dtype).tiny)
    steps = min(STEPS, seen - 1)
    begins = torch.arange(1, seen + 1 - steps, APART)
    before, now, *after = (z[:, begins + k].flatten(0, 1) for k in range(-1, steps + 1))
    return SeenMotion(size.repeat_interleave(len(begins)), before, now, torch.stack(after))


def _part(model: GausSim, batch: SceneBatch, mass: Float[Tensor, " M"], fps: float) -> PreparedMaterial:
    template, scene_id = cast(MaterialTemplate, model.template), batch.scene_ids[0]
    units = fixed_units(batch, mass, model.attributes[scene_id])[1][-1]
    matrices = template.matrices(scene_id, units.log_density, units.attributes, 1 / fps)
    return PreparedMaterial(template.body(scene_id), matrices, None)
