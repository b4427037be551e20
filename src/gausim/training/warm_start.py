"""Start of a training from the motion in the videos: initial states and material are fitted before the first step.

Rollouts from a state and a material at random do not resemble the videos, and images that do not overlap have no useful
loss gradient. So the motion of every sequence is tracked without dynamics, in the modes of the template
(:mod:`gausim.training.supervision.motion_tracks`), or taken from true points, and initial states, densities,
attributes and the template are fitted to it in modal coordinates (:mod:`gausim.training.modal_fit`). Training then
starts from there, with the network.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import cast

import torch
from torch import Tensor

from gausim.core import ConfigError
from gausim.models.initial_state import InitialStates
from gausim.models.step.simulator import GausSim
from gausim.runs.bar import with_bar
from gausim.training import modal_fit
from gausim.training.initial_fit import fit_initial_states
from gausim.training.learner import Learner
from gausim.training.modal_fit import KnownMotion
from gausim.training.optimizers import OptimizerSettings
from gausim.training.plan import USUAL, WarmStart
from gausim.training.tracking import Track

# Updates of the fit with the same sequences: steps that are alike take less time.
KEPT = 10


def warm_start(learner: Learner, tracks: Sequence[Track], settings: WarmStart, *, quiet: bool = False) -> None:
    """Fits initial states and material to tracked motion (:func:`gausim.training.tracking.track`).

    Of a frozen model only initial states are fitted (:mod:`gausim.training.initial_fit`).

    Raises:
        ConfigError: the template has no material to fit.
    """
    model, states = learner.model, cast(InitialStates, learner.initial_states)
    if not isinstance(model, GausSim) or not model.template.has_energy:
        raise ConfigError("plan.warm_start: expected a template with a material. Set plan.warm_start=null.")
    groups = {name: own for name, own in learner.groups().items() if name != "network"}
    if not any(p.requires_grad for name, own in groups.items() for p in own if name != "initial"):
        fit_initial_states(learner, tracks, quiet=quiet)
        return
    scenes: dict[int, list[Track]] = {}
    for known in tracks:
        scenes.setdefault(known.scene_id, []).append(known)
    motions = [(i, _known(learner, states, i, own, settings.sequences)) for i, own in scenes.items()]
    last = len(tracks[0].moved) - 1
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
    print(f"  warm start: without a network {final:.3f} of the motion is left", flush=True)


def _known(
    learner: Learner, states: InitialStates, scene_id: int, tracked: Sequence[Track], most: int
) -> Callable[[int], KnownMotion]:
    """T frames of some of the sequences of a scene as they were tracked, from their trained initial states."""
    draws, numbers = torch.Generator().manual_seed(0), [known.sequence_id for known in tracked]
    projection = cast(GausSim, learner.model).modal_projection(scene_id).flatten(0, 1)
    z = torch.stack([known.moved.flatten(1) @ projection for known in tracked])
    size = modal_fit.size_of(z[:, 1:])
    found = [learner.method.references(number, z.shape[1] - 1) for number in numbers]
    loads = [torch.stack([cast(Tensor, units.load) for _, units in own]) for own in found if own is not None]
    load = torch.stack(loads, 1) if loads else None

    rows, calls = list(range(len(numbers))), 0

    def known(steps: int) -> KnownMotion:
        nonlocal rows, calls
        if len(numbers) > most and calls % KEPT == 0:
            rows = torch.randperm(len(numbers), generator=draws)[:most].tolist()
        calls += 1
        motion = torch.stack([states.motion(numbers[i]) for i in rows])
        before, after = -motion.flatten(1) @ projection, z[rows, 1 : steps + 1].movedim(1, 0)
        own = None if load is None else load[:steps, rows]
        return KnownMotion(size[rows], before, torch.zeros_like(before), after, own)

    return known
