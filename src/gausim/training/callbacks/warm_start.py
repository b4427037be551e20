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
from dataclasses import replace
from typing import Any, cast

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from gausim.core import ConfigError
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SequenceSample
from gausim.models.initial_state import InitialStates
from gausim.models.step.simulator import GausSim
from gausim.runs.bar import with_bar
from gausim.training import modal_fit
from gausim.training.callbacks.cadence import training_data
from gausim.training.modal_fit import KnownMotion
from gausim.training.module import GausSimModule
from gausim.training.optimizers import OptimizerSettings, StableDecaySchedule
from gausim.training.supervision.images import Sources
from gausim.training.supervision.motion_tracks import TrackSupervision
from gausim.training.supervision.points import PointSupervision

# Predicted frames of the rollouts that the number of updates is meant for.
USUAL = 15
# Sequences of a scene, and displacements (F, K, 3) of their kernels in all frames [scene units].
Tracked = list[tuple[SequenceSample, Tensor]]


class WarmStart(Callback):
    """Tracks the motion of all training sequences and fits initial states and material to it, before the first step.

    It has no effect on models without modes, where bodies are free or above a floor, on supervision by true points of
    bodies in hands, and on runs that are resumed.
    """

    def __init__(
        self,
        *,
        updates: int = 300,
        sequences: int = 12,
        scene_lr: float = 0.1,
        template_lr: float = 1e-2,
        initial_lr: float = 2e-3,
        decay: float = 0.0,
        growing: float = 0.5,
        later: float = 0.2,
        epochs: int = 30,
    ) -> None:
        """Stores the settings.

        Args:
            updates: updates of the fit; 0 leaves out the warm start. Longer rollouts than of 15 frames get fewer, for
                the same cost.
            sequences: most sequences of an object in one update.
            scene_lr: learning rate of densities and attributes in the fit.
            template_lr: that of the template.
            initial_lr: that of the initial states.
            decay: weight decay of the attributes in the fit; without it, long fits follow the errors of the tracks.
            growing: fraction of the updates over which T grows to its largest. What a fit keeps is its best at that T:
                the earlier it is reached, the less harm is done by one that runs astray.
            later: factor on these three rates in the training that follows, which starts near the solution.
            epochs: most epochs of that training; its rates fall from the first on.
        """
        if updates < 0 or min(sequences, epochs) < 1 or min(decay, later) < 0 or not 0 < growing <= 1:
            raise ConfigError(
                "callbacks.warm_start: expected updates, decay and later >= 0, growing in (0, 1], sequences and epochs "
                f">= 1, got updates={updates}, decay={decay}, later={later}, growing={growing}, sequences={sequences}, "
                f"epochs={epochs}."
            )
        self._updates, self._sequences, self._later, self._epochs = updates, sequences, later, epochs
        self._growing = growing
        self._warm = False
        self._settings = OptimizerSettings(
            optimizer=torch.optim.AdamW,
            scene_lr=scene_lr,
            template_lr=template_lr,
            initial_lr=initial_lr,
            clip_per_group=True,
            decay={"scene": decay},
        )

    def plan(self, trainer: Trainer, module: GausSimModule, data: ReadyDataModule) -> None:
        """Decides whether there is a warm start.

        Then rollouts are as long as possible from the first epoch on, training is short, and its rates fall from the
        beginning.
        """
        self._warm = bool(self._updates) and _can_be_tracked(module, data)
        if not self._warm:
            return
        data.curriculum.grown = True
        trainer.fit_loop.max_epochs = min(trainer.max_epochs or self._epochs, self._epochs)
        schedule = module.settings.schedule
        if isinstance(schedule, StableDecaySchedule):
            module.settings = replace(module.settings, schedule=replace(schedule, decay=1.0))

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """The warm start, on the first rank for all."""
        if trainer.global_step or not self._warm:
            return
        assert isinstance(pl_module, GausSimModule)
        groups = {name: own for name, own in pl_module.groups().items() if name != "network"}
        weights = [p for own in groups.values() for p in own]

        def found() -> list[Tensor]:
            self._fit(pl_module, training_data(trainer), groups, quiet=not trainer.progress_bar_callback)
            return [p.detach().cpu() for p in weights]

        with torch.no_grad():
            for weight, value in zip(weights, pl_module.ranks.first(found), strict=True):
                weight.copy_(value.to(weight))
        for optimizer in trainer.optimizers:
            for group in optimizer.param_groups:  # saved with the optimiser, so a resumed run keeps the factor
                group["base_lr"] *= 1.0 if group["name"] == "network" else self._later

    def _fit(self, module: GausSimModule, data: ReadyDataModule, groups: Any, *, quiet: bool) -> None:
        model, last = cast(GausSim, module.model), data.curriculum.longest
        tracks, states = module.supervision, cast(InitialStates, module.initial_states)
        if not isinstance(tracks, PointSupervision):
            motions_of, image, references = model.smooth_motions, module.objective.image, module.method.references
            sources = Sources(model.scenes, lambda number: None, motions_of, module.renderer, image, references)
            tracks = TrackSupervision(sources)
        found: dict[int, Tracked] = {}
        count = len(data.index.entries)
        for number in with_bar(range(count), "Tracking the motion", quiet=quiet):
            sample = data.training_sample(number, last).to(module.device)
            moved = tracks.displacements(sample).to(module.device)
            states.set_motion(number, moved[1])
            found.setdefault(sample.scene_id, []).append((sample, moved))
        motions = [(i, _known(module, states, i, tracked, self._sequences)) for i, tracked in found.items()]
        updates = math.ceil(self._updates * min(1.0, USUAL / last))
        with torch.enable_grad():
            losses = modal_fit.fit(
                model, motions, self._settings, groups, longest=last, updates=updates, growing=self._growing
            )
            for loss in with_bar(losses, "Fitting the material", total=updates, quiet=quiet):
                final = loss
        sequences = f"{count} sequence{'s' if count != 1 else ''}"
        print(f"  warm start: {sequences} tracked; without a network {final:.3f} of the motion is left", flush=True)


def _known(
    module: GausSimModule, states: InitialStates, scene_id: int, tracked: Tracked, most: int
) -> Callable[[int], KnownMotion]:
    """T frames of some of the sequences of a scene as they were tracked, from their trained initial states."""
    draws, numbers = torch.Generator().manual_seed(0), [sample.sequence_id for sample, _ in tracked]
    projection = cast(GausSim, module.model).modal_projection(scene_id).flatten(0, 1)
    z = torch.stack([moved.flatten(1) @ projection for _, moved in tracked])
    size = modal_fit.size_of(z[:, 1:])
    found = [module.method.references(number, z.shape[1] - 1) for number in numbers]
    loads = [torch.stack([cast(Tensor, units.load) for _, units in own]) for own in found if own is not None]
    load = torch.stack(loads, 1) if loads else None

    def known(steps: int) -> KnownMotion:
        rows = torch.randperm(len(numbers), generator=draws)[:most].tolist()
        motion = torch.stack([states.motion(numbers[i]) for i in rows])
        before, after = -motion.flatten(1) @ projection, z[rows, 1 : steps + 1].movedim(1, 0)
        own = None if load is None else load[:steps, rows]
        return KnownMotion(size[rows], before, torch.zeros_like(before), after, own)

    return known


def _can_be_tracked(module: GausSimModule, data: ReadyDataModule) -> bool:
    model = module.model
    if not isinstance(model, GausSim) or not isinstance(module.initial_states, InitialStates):
        return False
    if type(module.supervision) is PointSupervision and any(map(module.method.hands, range(len(data.index.entries)))):
        return False
    alone = all(not scene.surroundings.free and scene.surroundings.floor is None for scene in model.scenes)
    return alone and all(model.template.basis(i) is not None for i in range(len(model.scenes)))
