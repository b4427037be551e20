"""The time budget of a run."""

from __future__ import annotations

import time
from typing import Any, cast

from lightning.pytorch import Callback, LightningModule, Trainer

from gausim.core import ConfigError
from gausim.training.module import GausSimModule


class TimeBudget(Callback):
    """Ends training after a number of minutes, resumed runs included; the current epoch is cut short and saved.

    The learning-rate schedule advances with the budget, so that it is completed. As times differ from run to run, so do
    the learning rates. Everything else is exact in a resumed run.
    """

    def __init__(self, *, minutes: float, clock: str = "wall") -> None:
        """``clock`` is ``wall``, or ``cpu`` for processor time of this process."""
        if clock not in ("wall", "cpu") or not minutes > 0:
            raise ConfigError(f"trainer: expected max_minutes > 0 and clock wall or cpu, got {minutes} and {clock!r}.")
        self._budget = 60.0 * minutes
        self._clock = time.monotonic if clock == "wall" else time.process_time
        self._used, self._mark = 0.0, 0.0

    @property
    def minutes_left(self) -> float:
        """Remaining time by the budget's clock [minutes]."""
        return max(0.0, self._budget - self._used) / 60.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Starts the clock; a resumed run's first step has the learning rate of the time used before."""
        self._mark = self._clock()
        self._drive(pl_module)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stops training when the budget is used up."""
        now = self._clock()
        # One clock for all ranks: their learning rates and their last step must agree.
        self._used = float(trainer.strategy.broadcast(self._used + now - self._mark))
        self._mark = now
        self._drive(pl_module)
        if self._used >= self._budget:
            trainer.should_stop = True

    def _drive(self, pl_module: LightningModule) -> None:
        cast(GausSimModule, pl_module).time_fraction = min(1.0, self._used / self._budget)

    def state_dict(self) -> dict[str, float]:
        """The time used."""
        return {"used": self._used}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Restores the time used."""
        self._used = float(state_dict["used"])
