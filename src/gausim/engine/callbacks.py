"""Callbacks of training: one line per epoch, the progress bar, the time budget, checkpoints."""

from __future__ import annotations

import csv
import math
import sys
import time
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint, RichProgressBar

from gausim.core import ConfigError
from gausim.engine.module import GausSimModule

LAST_CHECKPOINT = "last.ckpt"


class RunCheckpoint(Checkpoint):
    """Saves ``last.ckpt`` at the end of epochs, and numbered snapshots where asked for."""

    def __init__(self, *, every_epochs: int = 1, snapshot_every: int = 0) -> None:
        """Keeps the settings.

        Args:
            every_epochs: epochs between saves of ``last.ckpt``; the last epoch is always saved.
            snapshot_every: epochs between ``epoch_NNNN.ckpt`` files that stay; 0 is never.

        Raises:
            ConfigError: a number out of range.
        """
        if every_epochs < 1 or snapshot_every < 0:
            raise ConfigError(
                f"callbacks.checkpoint: expected every_epochs >= 1 and snapshot_every >= 0, got {every_epochs} and "
                f"{snapshot_every}."
            )
        self._every, self._snapshot_every = every_epochs, snapshot_every

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Saves when the epoch has come, the optimiser included (Lightning calls this last)."""
        epoch, folder = trainer.current_epoch + 1, Path(trainer.default_root_dir)
        last = trainer.should_stop or epoch == trainer.max_epochs
        if last or epoch % self._every == 0:
            trainer.save_checkpoint(folder / LAST_CHECKPOINT, weights_only=False)
        if self._snapshot_every and epoch % self._snapshot_every == 0:
            trainer.save_checkpoint(folder / "snapshots" / f"epoch_{epoch:04d}.ckpt", weights_only=False)


class EpochSummary(Callback):
    """One line per epoch on the console and one row per epoch in ``epochs.csv`` of the run."""

    COLUMNS = (
        "epoch", "step", "steps", "loss_image", "ratio_static", "excess_static", "ratio_first", "motion_energy",
        "loss_momentum", "momentum_share", "loss_static", "grad_network", "grad_scene",
        "grad_template", "grad_initial", "exploded",
        "lr", "seconds",
    )  # fmt: skip

    def __init__(self, *, console: bool = True) -> None:
        """``console`` prints the line; the row is written in any case."""
        self._console, self._began = console, 0.0

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts the clock."""
        self._began = time.monotonic()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Drops rows of epochs that a resumed run does again."""
        path = Path(trainer.default_root_dir) / "epochs.csv"
        if path.is_file():
            with path.open(newline="") as file:
                rows = [r for r in csv.DictReader(file) if int(r["epoch"]) <= trainer.current_epoch]
            self._write(path, rows)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the row and prints the line.

        Callbacks come before the module's own end of epoch, so the means are asked for here.
        """
        assert isinstance(pl_module, GausSimModule)
        means: dict[str, Any] = pl_module.epoch_means()
        means.update(epoch=trainer.current_epoch + 1, step=trainer.global_step, seconds=time.monotonic() - self._began)
        row = {name: _short(means[name]) if name in means else "" for name in self.COLUMNS}
        path = Path(trainer.default_root_dir) / "epochs.csv"
        self._write(path, [row], append=path.is_file())
        if self._console and trainer.is_global_zero:
            pl_module.print(self._line(trainer, means))
            sys.stdout.flush()  # where output is piped, the epochs of a long run should show as they end

    def _line(self, trainer: Trainer, means: dict[str, Any]) -> str:
        parts = [f"epoch {means['epoch']}/{trainer.max_epochs}", f"T {means.get('steps', math.nan):.0f}"]
        labels = {
            "loss_image": "loss {:.1f}", "excess_static": "{:.3f} of static", "ratio_first": "first frame {:.3f}",
            "motion_energy": "motion {:.2f}", "grad_network": "|g| {:.3g}", "momentum_share": "momentum {:.1%}",
        }  # fmt: skip
        parts += [text.format(means[name]) for name, text in labels.items() if name in means]
        if means.get("exploded", 0) > 0:
            parts.append(f"exploded {means['exploded']:.0%}")
        return "  ".join([*parts, f"{means['seconds']:.1f} s"])

    def _write(self, path: Path, rows: list[dict[str, Any]], *, append: bool = False) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a" if append else "w", newline="") as file:
            writer = csv.DictWriter(file, self.COLUMNS)
            if not append:
                writer.writeheader()
            writer.writerows(rows)


class TimeBudget(Callback):
    """Ends training after so many minutes, resumed runs included; the epoch under way is cut and saved."""

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

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts the clock."""
        self._mark = self._clock()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stops the training once the budget is used up."""
        now = self._clock()
        self._used, self._mark = self._used + now - self._mark, now
        if self._drives and isinstance(pl_module, GausSimModule):
            pl_module.time_fraction = min(1.0, self._used / self._budget)
        if self.spent:
            trainer.should_stop = True

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
        return {label: _short(stats[name]) for name, label in names.items() if name in stats}


def _short(value: Any) -> Any:
    return float(f"{value:.5g}") if isinstance(value, float) else value
