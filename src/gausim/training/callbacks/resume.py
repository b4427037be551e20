"""Checkpoints of a run, with the state that Lightning leaves out."""

import hashlib
import signal
import threading
import time
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint

from gausim.core import ConfigError
from gausim.runs.names import LAST_CHECKPOINT
from gausim.runs.randomness import random_state, restore_random_state
from gausim.training.ranks.ranks import Ranks


class RunCheckpoint(Checkpoint):
    """Saves ``last.ckpt`` after every epoch, and within epochs."""

    def __init__(self, *, every_minutes: float = 1.0, every_steps: int = 0) -> None:
        """Minutes and optimiser steps after which it saves within an epoch, 0: never; without effect on the result."""
        if min(every_minutes, every_steps) < 0:
            raise ConfigError(f"trainer.checkpoint_*: expected at least 0, got {every_minutes} and {every_steps}.")
        self._minutes, self._steps = every_minutes, every_steps
        self._saved_at, self._saved_step = time.monotonic(), 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts the clock."""
        self._saved_at, self._saved_step = time.monotonic(), trainer.global_step

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Saves within an epoch, but not after its last batch."""
        if not (trainer.is_last_batch or trainer.should_stop) and self._due(trainer):
            self._save(trainer)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Saves with the optimiser's state (Lightning calls this callback last)."""
        self._save(trainer)

    def _due(self, trainer: Trainer) -> bool:
        if self._steps and trainer.global_step - self._saved_step >= self._steps:
            return True
        # All ranks save together, so one clock decides.
        late = bool(self._minutes) and time.monotonic() - self._saved_at >= 60.0 * self._minutes
        return bool(trainer.strategy.broadcast(late))

    def _save(self, trainer: Trainer) -> None:
        for logger in trainer.loggers:
            logger.save()  # a kill loses no rows up to this step
        trainer.save_checkpoint(Path(trainer.default_root_dir) / LAST_CHECKPOINT, weights_only=False)
        self._saved_at, self._saved_step = time.monotonic(), trainer.global_step


class ExactResume(Callback):
    """Restores the state that Lightning does not: random generators and the end of a finished run.

    Since nothing is lost but what follows the last checkpoint, SIGTERM ends a run at once. Lightning would wait for the
    end of an update, and a warm start takes minutes.
    """

    def __init__(self) -> None:
        self._random: dict[str, Any] | None = None
        self._ranks = Ranks()

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Adds the state of each rank's global random generators and whether training ends with this epoch.

        Raises:
            RunError: the ranks' weights are no longer the same.
        """
        epochs: Any = trainer.fit_loop.epoch_progress.current
        at_epoch_end = epochs.processed > epochs.completed
        if self._ranks.size > 1:
            weights = [x.detach().cpu().contiguous().reshape(-1) for x in checkpoint["state_dict"].values()]
            found = hashlib.sha256(b"".join(x.view(torch.uint8).numpy().tobytes() for x in weights)).hexdigest()
            self._ranks.check_alike(found, f"weights at step {trainer.global_step}")
        states = self._ranks.gather(random_state())
        checkpoint["resume"] = {"random": states, "over": at_epoch_end and trainer.should_stop}

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Restores them; a run that had ended is not trained further."""
        own = checkpoint["resume"]
        if self._ranks.rank < len(own["random"]):  # an additional rank starts from its seed
            self._random = own["random"][self._ranks.rank]
        if own["over"]:
            trainer.should_stop = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Restores the generators, and gives SIGTERM its usual effect."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if self._random is not None:
            restore_random_state(self._random)
