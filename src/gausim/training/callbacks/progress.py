"""One line and one row per epoch, and the progress bar."""

import math
import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import RichProgressBar

from gausim.runs.names import EPOCHS
from gausim.training.module import GausSimModule
from gausim.training.table import Table, short

# Number of recent epochs from which the remaining time is estimated.
RECENT = 8


class EpochSummary(Callback):
    """One line per epoch on the console and one row per epoch in ``epochs.csv`` of the run."""

    COLUMNS = (
        "epoch", "step", "steps", "loss_image", "ratio_static", "excess_static", "ratio_first",
        "motion_energy", "loss_momentum", "loss_static", "grad_network",
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
        """Drops rows of epochs that a resumed run repeats, and continues the clock of an interrupted epoch."""
        self._began = time.monotonic() - self._elapsed
        if trainer.is_global_zero:
            self._table(trainer).resume_at(trainer.current_epoch)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes the row and prints the line.

        Lightning calls callbacks before the module's ``on_train_epoch_end``, so the means are computed here.
        """
        assert isinstance(pl_module, GausSimModule)
        means: dict[str, Any] = pl_module.epoch_means()
        means.update(epoch=trainer.current_epoch + 1, step=trainer.global_step, seconds=time.monotonic() - self._began)
        if not trainer.is_global_zero:
            return
        self._table(trainer).append({name: short(value) for name, value in means.items()})
        if self._console:
            pl_module.print(self._line(trainer, means))
            sys.stdout.flush()  # where output is piped, the epochs of a long run should show as they end

    def state_dict(self) -> dict[str, float]:
        """Time since the beginning of the current epoch [s]."""
        return {"elapsed": time.monotonic() - self._began}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Restores the time."""
        self._elapsed = float(state_dict["elapsed"])

    def _line(self, trainer: Trainer, means: dict[str, Any]) -> str:
        parts = [f"epoch {means['epoch']}/{trainer.max_epochs}", f"T {means.get('steps', math.nan):.0f}"]
        labels = {
            "loss_image": "loss {:.4g}", "excess_static": "loss/static {:.3f}", "ratio_first": "first frame {:.3f}",
            "motion_energy": "motion {:.2f}", "grad_network": "|g| {:.3g}",
        }  # fmt: skip
        parts += [text.format(means[name]) for name, text in labels.items() if name in means]
        if means.get("exploded", 0) > 0:
            parts.append(f"exploded {means['exploded']:.0%}")
        parts.append(f"{means['seconds']:.1f} s")
        self._paces.append((int(means.get("steps", 0)), means["seconds"]))
        module = cast(GausSimModule, trainer.lightning_module)
        # Epochs of a fit's stages differ in length.
        left = None if module.initial_states is None else _minutes_left(trainer, self._paces)
        if left is not None:
            parts.append(f"about {max(0.0, left):.0f} min left")
        return "  ".join(parts)

    def _table(self, trainer: Trainer) -> Table:
        return Table(Path(trainer.default_root_dir) / EPOCHS, "epoch", self.COLUMNS)


def _minutes_left(trainer: Trainer, paces: Sequence[tuple[int, float]]) -> float | None:
    """Time of the remaining epochs, from the recent time per predicted frame [minutes]; None without epochs."""
    done, epochs = trainer.current_epoch + 1, trainer.max_epochs or 0
    shown = sum(steps for steps, _ in paces)
    if done >= epochs or not shown:
        return None
    module = cast(GausSimModule, trainer.lightning_module)
    frames = sum(module.plan.steps(epoch) for epoch in range(done, epochs))
    left = frames * sum(seconds for _, seconds in paces) / shown / 60.0
    limit = module.plan.max_minutes
    return left if limit is None else min(left, limit - module.minutes)


class Progress(RichProgressBar):
    """Lightning's rich progress bar with the metrics of training."""

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """T, the loss against the static prediction's, and the motion energy."""
        stats = getattr(pl_module, "last_stats", {})
        names = {"steps": "T", "excess_static": "loss/static", "motion_energy": "motion"}
        return {label: short(stats[name]) for name, label in names.items() if name in stats}
