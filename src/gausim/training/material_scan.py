"""The material of bodies of which some frames are known: a scan for its even part, then a fit by descent."""

from collections.abc import Callable
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.data.pretraining import BodyData, CorpusDataModule
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import MaterialTemplate
from gausim.runs.bar import with_bar
from gausim.training import modal_fit
from gausim.training.modal_fit import KnownMotion
from gausim.training.optimizers import OptimizerSettings

# Candidates, scanned in turn: logarithms of stiffness over the reference's, and of drag [1 / frame at 24 per second].
STIFFNESS, DRAG = torch.linspace(-3.5, 3.5, 15), torch.linspace(-8, 0.5, 9)
MOST_TURNS = 8
# Most steps of the compared rollouts, and frames between their beginnings.
STEPS, APART = 4, 2
# Updates of the fit of a body, its learning rate, and most beginnings of rollouts of every sequence in one of them.
UPDATES, RATE, BEGINNINGS = 200, 0.1, 4


def find_materials(model: GausSim, data: CorpusDataModule) -> None:
    """Fits densities and attributes of every body to its seen frames, by rollouts of the template alone.

    The loss of a fit by descent has many minima in a stiffness or damping that is several times too large or too small.
    A scan of these two numbers, even over the body, finds where to begin.
    """
    settings = OptimizerSettings(scene_lr=RATE, clip_norm=0.0)
    for scene_id, item in enumerate(with_bar(cast("list[BodyData]", data.objects), "Fitting materials")):
        z = _coordinates(model, scene_id, item)
        _scan(model, scene_id, z)
        groups = {"scene": [model.attributes[scene_id], model.log_density[scene_id]]}
        longest = z.shape[1] - 2
        for _ in modal_fit.fit(model, [(scene_id, _beginnings(z))], settings, groups, longest=longest, updates=UPDATES):
            pass


@torch.no_grad()
def _scan(model: GausSim, scene_id: int, z: Float[Tensor, "S F M"]) -> None:
    """Sets attributes 0 and 1 of a body to the even material that explains its seen frames best."""
    attributes, steps = model.attributes[scene_id].data, min(STEPS, z.shape[1] - 2)
    motion = known_motion(z, torch.arange(1, z.shape[1] - steps, APART), steps)
    candidates = STIFFNESS, DRAG - cast(MaterialTemplate, model.template).log_drag
    unchanged, turn = 0, 0
    while unchanged < len(candidates) and turn < MOST_TURNS:
        number, errors = turn % len(candidates), []
        before = attributes[0, number].clone()
        for value in candidates[number]:
            attributes[:, number] = value
            errors.append(motion.error(model.modal_scene(scene_id)))
        attributes[:, number] = candidates[number][int(torch.stack(errors).argmin())]
        unchanged, turn = unchanged + 1 if attributes[0, number] == before else 0, turn + 1


def _coordinates(model: GausSim, scene_id: int, item: BodyData) -> Float[Tensor, "S F M"]:
    """Modal coordinates of a body's sequences in the frame before the first and all seen ones."""
    moved = item.body.positions[:, : len(item.train_frames) + 1] - item.body.rest
    return moved.flatten(2) @ model.modal_projection(scene_id).flatten(0, 1).to(moved)


def known_motion(z: Float[Tensor, "S F M"], begins: Tensor, steps: int) -> KnownMotion:
    """Rollouts of ``steps`` frames of every sequence from some frames."""
    before, now, *after = (z[:, begins + k].flatten(0, 1) for k in range(-1, steps + 1))
    size = modal_fit.size_of(z[:, 1:])
    return KnownMotion(size.repeat_interleave(len(begins)), before, now, torch.stack(after))


def _beginnings(z: Float[Tensor, "S F M"]) -> Callable[[int], KnownMotion]:
    draws = torch.Generator().manual_seed(0)

    def known(steps: int) -> KnownMotion:
        begins = 1 + torch.randperm(z.shape[1] - 1 - steps, generator=draws)[:BEGINNINGS]
        return known_motion(z, begins, steps)

    return known
