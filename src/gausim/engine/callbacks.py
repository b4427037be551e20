"""Callbacks of training: one line per epoch, the progress bar, the time budget, checkpoints."""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint, RichProgressBar

from gausim.core import ConfigError
from gausim.data.datamodule import ReadyDataModule
from gausim.engine.cadence import has_come
from gausim.engine.checkpoint import BEFORE_THE_END, LAST_CHECKPOINT, digest
from gausim.engine.convergence import Convergence
from gausim.engine.epoch_table import EpochTable, short
from gausim.engine.loggers import Resumable
from gausim.engine.module import GausSimModule
from gausim.engine.randomness import random_state, restore_random_state
from gausim.engine.ranks import Ranks

EPOCHS = "epochs.csv"
# Epochs that the time left is told from.
RECENT = 8


class RunCheckpoint(Checkpoint):
    """Saves ``last.ckpt`` every so often, within epochs too, and numbered snapshots where asked for.

    Where its allowance and not convergence begins the end of a run, ``before_the_end.ckpt`` is what more time goes on
    from.
    """

    def __init__(
        self, *, every_epochs: int = 1, every_minutes: float = 1.0, every_steps: int = 0, snapshot_every: int = 0
    ) -> None:
        """Keeps the settings; none of them changes what is learned.

        Args:
            every_epochs: epochs between saves of ``last.ckpt``; the last epoch is always saved.
            every_minutes: wall-clock minutes after which it is saved within an epoch; 0 is never.
            every_steps: optimiser steps after which it is saved within an epoch; 0 is never.
            snapshot_every: epochs between ``epoch_NNNN.ckpt`` files that stay; 0 is never.

        Raises:
            ConfigError: a number out of range.
        """
        if every_epochs < 1 or min(every_minutes, every_steps, snapshot_every) < 0:
            raise ConfigError(
                "callbacks.checkpoint: expected every_epochs >= 1 and every_minutes, every_steps, snapshot_every >= 0, "
                f"got {every_epochs}, {every_minutes}, {every_steps} and {snapshot_every}."
            )
        self._every, self._snapshot_every = every_epochs, snapshot_every
        self._minutes, self._steps = every_minutes, every_steps
        self._saved_at, self._saved_step = time.monotonic(), 0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Counts from here."""
        self._saved_at, self._saved_step = time.monotonic(), trainer.global_step

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Saves within an epoch; where the epoch is about to end, its end saves."""
        if not (trainer.is_last_batch or trainer.should_stop) and self._due(trainer):
            self._save(trainer)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Saves when the epoch has come, the optimiser included (Lightning calls this last)."""
        if has_come(trainer, self._every) or self._due(trainer):
            self._save(trainer)
        epoch = trainer.current_epoch + 1
        if any(isinstance(c, Convergence) and c.began_to_end(trainer) for c in cast(Any, trainer).callbacks):
            trainer.save_checkpoint(Path(trainer.default_root_dir) / BEFORE_THE_END, weights_only=False)
        if self._snapshot_every and epoch % self._snapshot_every == 0:
            snapshots = Path(trainer.default_root_dir) / "snapshots"
            trainer.save_checkpoint(snapshots / f"epoch_{epoch:04d}.ckpt", weights_only=False)

    def _due(self, trainer: Trainer) -> bool:
        if self._steps and trainer.global_step - self._saved_step >= self._steps:
            return True
        # All ranks save together, so one clock decides.
        late = bool(self._minutes) and time.monotonic() - self._saved_at >= 60.0 * self._minutes
        return bool(trainer.strategy.broadcast(late))

    def _save(self, trainer: Trainer) -> None:
        for logger in trainer.loggers:
            logger.save()  # rows up to this step must not be lost: a resumed run does not log them again
        trainer.save_checkpoint(Path(trainer.default_root_dir) / LAST_CHECKPOINT, weights_only=False)
        self._saved_at, self._saved_step = time.monotonic(), trainer.global_step


class ExactResume(Callback):
    """Restores what Lightning does not: random generators, loggers' rows, and that a run was already over."""

    def __init__(self) -> None:
        """Nothing to set."""
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
            self._ranks.check_alike(digest(checkpoint["state_dict"]), f"weights at step {trainer.global_step}")
        states = self._ranks.gather(random_state())
        checkpoint["resume"] = {"random": states, "over": at_epoch_end and trainer.should_stop}

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Takes them; a run that was stopped for good is not trained further."""
        own = checkpoint["resume"]
        if self._ranks.rank < len(own["random"]):  # one that was not there draws from its seed
            self._random = own["random"][self._ranks.rank]
        if own["over"]:
            trainer.should_stop = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Restores the generators and drops what the loggers hold of steps that will be done again."""
        if self._random is not None:
            restore_random_state(self._random)
        for logger in trainer.loggers:
            if isinstance(logger, Resumable):
                logger.resume_at(trainer.global_step)


class EpochSummary(Callback):
    """One line per epoch on the console and one row per epoch in ``epochs.csv`` of the run."""

    COLUMNS = (
        "epoch", "step", "steps", "loss_image", "ratio_static", "excess_static", "held_back", "ratio_first",
        "motion_energy", "loss_momentum", "momentum_share", "loss_static", "energy_growth", "grad_network",
        "grad_scene", "grad_template", "grad_initial", "exploded",
        "lr", "seconds",
    )  # fmt: skip

    def __init__(self, *, console: bool = True) -> None:
        """``console`` prints the line; the row is written in any case."""
        self._console, self._began, self._elapsed = console, time.monotonic(), 0.0
        self._paces: deque[tuple[int, float]] = deque(maxlen=RECENT)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts the clock."""
        self._began = time.monotonic()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Drops rows of epochs that a resumed run does again, and goes on with the clock of a cut epoch."""
        self._began = time.monotonic() - self._elapsed
        if trainer.is_global_zero:
            self._table(trainer).resume_at(trainer.current_epoch)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the row and prints the line.

        Callbacks come before the module's own end of epoch, so the means are asked for here.
        """
        assert isinstance(pl_module, GausSimModule)
        means: dict[str, Any] = pl_module.epoch_means()
        means.update(epoch=trainer.current_epoch + 1, step=trainer.global_step, seconds=time.monotonic() - self._began)
        if not trainer.is_global_zero:
            return
        self._table(trainer).append(means)
        if self._console:
            pl_module.print(self._line(trainer, means))
            sys.stdout.flush()  # where output is piped, the epochs of a long run should show as they end

    def state_dict(self) -> dict[str, float]:
        """Seconds that the epoch under way has taken."""
        return {"elapsed": time.monotonic() - self._began}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Takes them."""
        self._elapsed = float(state_dict["elapsed"])

    def _line(self, trainer: Trainer, means: dict[str, Any]) -> str:
        parts = [f"epoch {means['epoch']}/{trainer.max_epochs}", f"T {means.get('steps', math.nan):.0f}"]
        labels = {
            "loss_image": "loss {:.4g}", "excess_static": "{:.3f} of static", "ratio_first": "first frame {:.3f}",
            "held_back": "held back {:.3f}", "motion_energy": "motion {:.2f}", "grad_network": "|g| {:.3g}",
            "momentum_share": "momentum {:.1%}",
        }  # fmt: skip
        parts += [text.format(means[name]) for name, text in labels.items() if name in means]
        if means.get("exploded", 0) > 0:
            parts.append(f"exploded {means['exploded']:.0%}")
        parts.append(f"{means['seconds']:.1f} s")
        fitted = hasattr(trainer.lightning_module, "plan")  # in stages, which have lengths of their own
        self._paces.append((int(means.get("steps", 0)), means["seconds"]))
        left = None if fitted else _minutes_left(trainer, self._paces)
        judged = any(isinstance(c, Convergence) and c.is_learning for c in cast(Any, trainer).callbacks)
        return "  ".join(
            [*parts, *([] if left is None else [f"{'at most' if judged else 'about'} {left:.0f} min left"])]
        )

    def _table(self, trainer: Trainer) -> EpochTable:
        return EpochTable(Path(trainer.default_root_dir) / EPOCHS, self.COLUMNS)


def _minutes_left(trainer: Trainer, paces: Sequence[tuple[int, float]]) -> float | None:
    """What the epochs to come will take, by a line through T and seconds of those that are over [minutes].

    None where there are none, where nothing says how many frames they predict, or where all that are over had
    one T, which tells nothing about another.
    """
    data: Any = getattr(trainer, "datamodule", None)
    done, epochs = trainer.current_epoch + 1, trainer.max_epochs or 0
    if not isinstance(data, ReadyDataModule) or done >= epochs:
        return None
    coming = np.array([data.steps(epoch) for epoch in range(done, epochs)])
    steps, seconds = np.array(paces).T
    alike = np.ptp(steps) == 0
    if alike and (coming != steps[0]).any():
        return None
    slope = 0.0 if alike else max(0.0, float(np.polyfit(steps, seconds, 1)[0]))
    left = float(np.maximum(seconds.mean() + slope * (coming - steps.mean()), 0.0).sum()) / 60.0
    budgets = [c.minutes_left for c in cast(Any, trainer).callbacks if isinstance(c, TimeBudget)]
    return float(min([left, *budgets]))


class TimeBudget(Callback):
    """Ends training after so many minutes, resumed runs included; the epoch under way is cut and saved.

    A clock never runs twice alike: with ``drives_schedule`` the learning rates, and without it the number of steps,
    differ between any two runs. A resumed run is exact in everything else.
    """

    def __init__(self, *, minutes: float, clock: str = "wall", drives_schedule: bool = True) -> None:
        """Keeps the settings.

        Args:
            minutes: the budget.
            clock: ``wall``, or ``cpu`` for processor time of this process.
            drives_schedule: the learning-rate schedule also advances with the budget, so that it comes to its end.

        Raises:
            ConfigError: an unknown clock or a budget that is not positive.
        """
        if clock not in ("wall", "cpu") or not minutes > 0:
            raise ConfigError(f"trainer: expected max_minutes > 0 and clock wall or cpu, got {minutes} and {clock!r}.")
        self._budget, self._drives = 60.0 * minutes, drives_schedule
        self._clock = time.monotonic if clock == "wall" else time.process_time
        self._used, self._mark = 0.0, 0.0

    @property
    def spent(self) -> bool:
        """Whether the budget is used up."""
        return self._used >= self._budget

    @property
    def minutes_left(self) -> float:
        """What is left of the budget, on its own clock [minutes]."""
        return max(0.0, self._budget - self._used) / 60.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts the clock; a resumed run's first step has the learning rate of the time used so far."""
        self._mark = self._clock()
        self._drive(pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stops the training once the budget is used up."""
        now = self._clock()
        # One clock for all ranks: their learning rates and their last step must agree.
        self._used = float(trainer.strategy.broadcast(self._used + now - self._mark))
        self._mark = now
        self._drive(pl_module)
        if self.spent:
            trainer.should_stop = True

    def _drive(self, pl_module: LightningModule) -> None:
        if self._drives and isinstance(pl_module, GausSimModule):
            pl_module.time_fraction = min(1.0, self._used / self._budget)

    def state_dict(self) -> dict[str, float]:
        """The time used."""
        return {"used": self._used}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Continues to count."""
        self._used = float(state_dict["used"])


class Progress(RichProgressBar):
    """Lightning's rich progress bar with our numbers."""

    def __init__(self, *, refresh_rate: int = 1, leave: bool = False) -> None:
        """``refresh_rate`` in batches; ``leave`` keeps the bar of every epoch."""
        super().__init__(refresh_rate=refresh_rate, leave=leave)

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """T, the loss against the static prediction's, and the motion energy."""
        stats = getattr(pl_module, "last_stats", {})
        names = {"steps": "T", "excess_static": "of static", "motion_energy": "motion"}
        return {label: short(stats[name]) for name, label in names.items() if name in stats}
