"""LightningModule of training: hooks around the optimiser step (:mod:`gausim.training.step`), metrics, checkpoints."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from lightning.pytorch import LightningModule
from torch import Tensor

from gausim.core import GaussianScene
from gausim.data.dataset import SequenceSample
from gausim.data.sampler import hash_seed
from gausim.runs.checkpoint import check_scenes, fingerprints
from gausim.runs.cost import TrainingCost
from gausim.training.optimizers import set_rates
from gausim.training.plan import TrainingPlan
from gausim.training.stages import begin
from gausim.training.step import OptimiserStep
from gausim.training.supervision.motion_tracks import TrackSupervision

# Below this fraction of the true motion energy a prediction counts as collapsed to the rest state.
COLLAPSED = 0.05
# Optimiser steps before a collapse is reported: initial states begin at rest, so every run begins static.
COLLAPSE_AFTER = 100


class GausSimModule(OptimiserStep, LightningModule):
    """Trains a method: rollout, rendering, losses and one optimiser step per batch.

    The backward pass runs after every stretch of the rollout, so that memory does not grow with T. Each of several
    ranks computes a part of the sequences; sums of loss gradients, statistics and metrics over the ranks equal those of
    a single rank.
    """

    def __init__(self, *, plan: TrainingPlan | None = None, seed: int = 0, **parts: Any) -> None:
        """Stores the ``parts`` of a :class:`~gausim.training.learner.Learner`.

        Args:
            plan: the resolved plan; constant rates when None.
            seed: seed of each step's random numbers (static loss), together with the step's number.
            parts: arguments of the learner.
        """
        super().__init__(**parts)
        self.automatic_optimization = False
        self.seed = seed
        self.summary: dict[str, float] = {}
        self.last_stats: dict[str, float] = {}
        self.plan, self.minutes = plan or TrainingPlan(schedule=None, warm_start=None), 0.0
        self._sums: dict[str, list[float]] = {}
        self._warned, self.cost = False, TrainingCost()

    @property
    def scenes(self) -> Sequence[GaussianScene]:
        """The rest scenes; their index is the ``scene_id`` of samples."""
        return self.simulator.scenes

    @property
    def method_name(self) -> str:
        """Name of the predictions in tables."""
        return self.method.name

    @property
    def footnotes(self) -> dict[str, Any]:
        """That the method extrapolates, notes on its figures, and the cost of training."""
        fit = self.cost.summary() if self.cost.seconds else None
        return {"extrapolates": True, "notes": self.notes(), "fit": fit}

    def notes(self) -> list[str]:
        """Notes on the figures, in sentences."""
        return self.cost.notes()

    # ------------------------------------------------------------------------------------------------ one step

    def training_step(self, samples: list[SequenceSample], batch_idx: int) -> None:
        """Predicts and renders the batch, and makes one optimiser step."""
        optimizer, trainer = cast(Any, self.optimizers()), self.trainer
        batches = float(trainer.num_training_batches)
        done = self.plan.progress(self.current_epoch + batch_idx / max(1.0, batches), self.minutes)
        set_rates(optimizer.optimizer, lambda name: self.plan.rate_factor(name, done))
        draws = torch.Generator().manual_seed(hash_seed(self.seed, self.global_step))
        stats = self.optimise(samples, optimizer.optimizer, draws, optimizer.step)
        rate = self.settings.network_lr * self.plan.rate_factor("network", done)
        self._record({**stats, "lr": rate}, self.shown)
        self._look_at_the_clock()
        if self.plan.time_fraction(self.minutes) >= 1:
            trainer.should_stop = True

    def _look_at_the_clock(self) -> None:
        """Measures the training time, on the first rank for all: their learning rates and their end must agree."""
        if self.plan.max_minutes is not None:
            self.minutes = self.ranks.first(lambda: self.cost.minutes(self.plan.clock))

    def accumulate(self, loss: Tensor) -> None:
        """Adds the gradients of a loss, through the trainer if there is one."""
        if self._trainer is None:
            super().accumulate(loss)
        elif loss.requires_grad:
            self.manual_backward(loss)

    # ------------------------------------------------------------------------------------------------ numbers

    def _record(self, stats: dict[str, float], weight: int) -> None:
        self.last_stats = stats
        for name, value in stats.items():
            entry = self._sums.setdefault(name, [0.0, 0.0])
            entry[0] += value * weight
            entry[1] += weight
        every = getattr(self.trainer, "log_every_n_steps", 0)
        if every and self.global_step % every == 0:
            for logger in self.trainer.loggers:
                logger.log_metrics({f"train/{k}": v for k, v in stats.items()}, step=self.global_step)

    def epoch_means(self) -> dict[str, float]:
        """Means over the sequences of the epoch so far."""
        return {name: total / weight for name, (total, weight) in self._sums.items() if weight}

    def on_train_start(self) -> None:
        """Starts to measure the cost of training, and makes the first stages of a run that is not resumed."""
        self.cost.begin()
        self._look_at_the_clock()
        if not self.global_step:
            trainer = cast(Any, self.trainer)
            begin(self, trainer.datamodule, self.plan, seed=self.seed, quiet=not trainer.progress_bar_callback)

    def on_train_epoch_start(self) -> None:
        """Resets the epoch's sums."""
        self._sums.clear()

    def on_train_epoch_end(self) -> None:
        """Computes the epoch's means and warns of a collapse."""
        self.summary = self.epoch_means()
        row = {f"epoch/{name}": value for name, value in self.summary.items()}
        for logger in self.trainer.loggers:  # not log_dict: Lightning would write it after the epoch's checkpoint
            logger.log_metrics({"epoch": self.current_epoch, **row}, step=self.global_step)
        energy = self.summary.get("motion_energy")
        if energy is not None and energy < COLLAPSED and self.global_step >= COLLAPSE_AFTER and not self._warned:
            self._warned = True
            warnings.warn(
                f"the prediction has collapsed to the rest state: it moves with {100 * energy:.1f} % of the true "
                "motion energy. Let T grow more slowly (plan.repeats), raise "
                "optimizer.initial_lr or use loss.backprop_steps > 1.",
                stacklevel=2,
            )

    # ------------------------------------------------------------------------------------------------ checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the scenes' fingerprints and the epoch's sums."""
        own: dict[str, Any] = {"scenes": fingerprints(self.simulator.scenes)}
        own["epoch"] = {"sums": self._sums, "summary": self.summary, "warned": self._warned, "barren": self.barren}
        own["baselines"] = self.baselines.state_dict()
        if isinstance(self.supervision, TrackSupervision):
            own["tracks"] = self.supervision.state_dict()
        checkpoint["gausim"], checkpoint["cost"] = own, self.cost.state_dict()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses a checkpoint of other scenes; restores what :meth:`on_save_checkpoint` added.

        Raises:
            RunError: the checkpoint is of other scenes.
        """
        check_scenes(checkpoint, self.simulator.scenes, "the checkpoint")
        self.take_notes(checkpoint)
        own = checkpoint["gausim"]
        epoch = own["epoch"]
        self._sums, self.summary = epoch["sums"], epoch["summary"]
        self._warned, self.barren = epoch["warned"], epoch["barren"]
        self.baselines.load_state_dict(own["baselines"])
        if isinstance(self.supervision, TrackSupervision):
            self.supervision.load_state_dict(own.get("tracks", {}))

    def take_notes(self, checkpoint: Mapping[str, Any]) -> None:
        """Restores from a checkpoint what :attr:`footnotes` needs."""
        self.cost.load_state_dict(checkpoint["cost"])
