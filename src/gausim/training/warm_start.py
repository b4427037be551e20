"""Start of a training from the motion in the videos: initial states and material are fitted before the first step.

Rollouts from a state and a material at random do not resemble the videos, and images that do not overlap have no useful
loss gradient. So the motion of every sequence is tracked without dynamics, in the modes of the template
(:mod:`gausim.training.supervision.motion_tracks`), or taken from true points, and initial states, densities,
attributes and the template are fitted to it in modal coordinates (:mod:`gausim.training.modal_fit`). Training then
starts from there, with the network.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor

from gausim.core import ConfigError
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SequenceSample
from gausim.models.initial_state import InitialStates
from gausim.models.step.simulator import GausSim
from gausim.runs.bar import with_bar
from gausim.training import modal_fit
from gausim.training.learner import Learner
from gausim.training.modal_fit import KnownMotion
from gausim.training.optimizers import OptimizerSettings
from gausim.training.plan import USUAL, TrainingPlan, WarmStart
from gausim.training.supervision.images import Sources
from gausim.training.supervision.motion_tracks import TrackSupervision
from gausim.training.supervision.points import PointSupervision

# Sequences of a scene, and displacements (F, K, 3) of their kernels in all frames [scene units].
Tracked = list[tuple[SequenceSample, Tensor]]


def warm_start(learner: Learner, data: ReadyDataModule, settings: WarmStart, *, quiet: bool = False) -> None:
    """Tracks all training sequences and fits initial states and material to them, on the first rank for all.

    Raises:
        ConfigError: the model has no modes in which motion is tracked.
    """
    model = learner.model
    if not isinstance(model, GausSim) or any(model.template.basis(i) is None for i in range(len(model.scenes))):
        raise ConfigError("plan.warm_start: expected a model whose template has modes. Set plan.warm_start=null.")
    groups = {name: own for name, own in learner.groups().items() if name != "network"}
    weights = [p for own in groups.values() for p in own]

    def fitted() -> list[Tensor]:
        _fit(learner, data, settings, groups, quiet=quiet)
        return [p.detach().cpu() for p in weights]

    with torch.no_grad():
        for weight, value in zip(weights, learner.ranks.first(fitted), strict=True):
            weight.copy_(value.to(weight))


def _fit(learner: Learner, data: ReadyDataModule, settings: WarmStart, groups: Any, *, quiet: bool) -> None:
    model, last = cast(GausSim, learner.model), cast(TrainingPlan, data.plan).t_max or 1
    tracks, states = learner.supervision, cast(InitialStates, learner.initial_states)
    device = next(model.parameters()).device
    if not isinstance(tracks, PointSupervision):
        motions_of, image, references = model.smooth_motions, learner.objective.image, learner.method.references
        sources = Sources(model.scenes, lambda number: None, motions_of, learner.renderer, image, references)
        tracks = TrackSupervision(sources)
    tracked: dict[int, Tracked] = {}
    count = len(data.index.entries)
    for number in with_bar(range(count), "Tracking the motion", quiet=quiet):
        sample = data.training_sample(number, last).to(device)
        moved = tracks.displacements(sample).to(device)
        states.set_motion(number, moved[1])
        tracked.setdefault(sample.scene_id, []).append((sample, moved))
    motions = [(i, _known(learner, states, i, own, settings.sequences)) for i, own in tracked.items()]
    updates = math.ceil(settings.updates * min(1.0, USUAL / last))
    rates = OptimizerSettings(
        optimizer=torch.optim.AdamW,
        scene_lr=settings.scene_lr,
        template_lr=settings.template_lr,
        initial_lr=settings.initial_lr,
        clip_per_group=True,
        decay={"scene": settings.decay},
    )
    with torch.enable_grad():
        losses = modal_fit.fit(model, motions, rates, groups, longest=last, updates=updates, growing=settings.growing)
        for loss in with_bar(losses, "Fitting the material", total=updates, quiet=quiet):
            final = loss
    sequences = f"{count} sequence{'s' if count != 1 else ''}"
    print(f"  warm start: {sequences} tracked; without a network {final:.3f} of the motion is left", flush=True)


def _known(
    learner: Learner, states: InitialStates, scene_id: int, tracked: Tracked, most: int
) -> Callable[[int], KnownMotion]:
    """T frames of some of the sequences of a scene as they were tracked, from their trained initial states."""
    draws, numbers = torch.Generator().manual_seed(0), [sample.sequence_id for sample, _ in tracked]
    projection = cast(GausSim, learner.model).modal_projection(scene_id).flatten(0, 1)
    z = torch.stack([moved.flatten(1) @ projection for _, moved in tracked])
    size = modal_fit.size_of(z[:, 1:])
    found = [learner.method.references(number, z.shape[1] - 1) for number in numbers]
    loads = [torch.stack([cast(Tensor, units.load) for _, units in own]) for own in found if own is not None]
    load = torch.stack(loads, 1) if loads else None

    def known(steps: int) -> KnownMotion:
        rows = torch.randperm(len(numbers), generator=draws)[:most].tolist()
        motion = torch.stack([states.motion(numbers[i]) for i in rows])
        before, after = -motion.flatten(1) @ projection, z[rows, 1 : steps + 1].movedim(1, 0)
        own = None if load is None else load[:steps, rows]
        return KnownMotion(size[rows], before, torch.zeros_like(before), after, own)

    return known
