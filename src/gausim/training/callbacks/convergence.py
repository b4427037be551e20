"""Convergence of training, measured by a forecast of training frames that are held back.

A run trains at constant learning rates on rollouts that end before the last training frames. After each epoch the
frames held back are predicted. When that forecast no longer improves, or the limit of epochs or minutes is near, the
final part begins: all training frames are used, and the rates fall (``training.optimizers.StableDecaySchedule``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from gausim.core import ConfigError, DivergenceError
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SequenceSample
from gausim.nn.mode import evaluating
from gausim.training.callbacks.cadence import training_data
from gausim.training.module import GausSimModule
from gausim.training.optimizers import StableDecaySchedule
from gausim.training.rollout import States, windows
from gausim.training.statistics import excess

# Shows of a sequence over which an improvement is measured.
PER_SHOWS = 10
# Relative error of the forecast above which almost nothing was learned; 1 is the error of the rest state.
LITTLE = 0.8
# Fraction of the rest state's loss due to motion, below which the frames contain almost no motion to learn.
STILL = 0.05


@dataclass(frozen=True)
class Forecast:
    """Errors of the forecast of frames held back."""

    error: float  # loss of the prediction over that of the rest state, both less the floor (the loss on frame 0)
    moving: float  # fraction of the rest state's loss that is above the floor


class Convergence(Callback):
    """Measures the forecast after each epoch, and begins the final part of the run.

    Active only with :class:`~gausim.training.optimizers.StableDecaySchedule` and ``decay`` < 1, and if the curriculum's
    first T leaves frames to hold back; otherwise the run has ``max_epochs`` epochs.

    Attributes:
        forecasts: one per epoch since T reached its largest value without the frames held back.
        converged: whether the forecast ceased to improve.
    """

    def __init__(self, *, held_back: int = 4, window: int = 40, tolerance: float = 0.01, sequences: int = 12) -> None:
        """``conf/base/more.yaml`` explains the settings."""
        if min(held_back, window, sequences) < 1 or not 0 <= tolerance < 1:
            raise ConfigError(
                "trainer.convergence: expected held_back, window, sequences >= 1 and tolerance in [0, 1), got "
                f"{held_back}, {window}, {sequences} and {tolerance}."
            )
        self._held_back, self._window, self._tolerance = held_back, window, tolerance
        self._sequences, self._shows, self._allowance = sequences, 1, 0
        self.forecasts: list[Forecast] = []
        self.converged, self._judges = False, False
        self._ending_since: int | None = None  # epochs done at the beginning of the final part

    # ------------------------------------------------------------------------------------------------ training

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Holds frames back, or continues the final part of a resumed run."""
        data = training_data(trainer)
        self._shows = data.repeats
        allowance = trainer.max_epochs or 0
        if self._ending_since is not None and allowance > self._allowance and not self.converged:
            self._ending_since = None  # it was cut short, and now has more epochs or minutes
        self._allowance = allowance
        self._judges = self._active(pl_module, data)
        if self._judges:
            self._apply(trainer, pl_module)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Measures the forecast, and begins the final part when it is due, on all ranks alike."""
        data = training_data(trainer)
        if not self.is_learning:
            return
        assert isinstance(pl_module, GausSimModule)
        done = trainer.current_epoch + 1
        if data.steps(trainer.current_epoch) >= data.curriculum.longest:
            forecast = self._judge(trainer, pl_module, data) if trainer.is_global_zero else None
            self.forecasts.append(cast(Forecast, trainer.strategy.broadcast(forecast)))
            pl_module.note("held_back", self.forecasts[-1].error)
        self.converged = self.improvement is not None and self.improvement < self._tolerance
        spent = max(done / max(1, self._allowance), pl_module.time_fraction)
        if self.converged or spent >= 1 - _decay(pl_module):
            self._ending_since = done
            self._apply(trainer, pl_module)

    @property
    def is_learning(self) -> bool:
        """Whether it is active and the final part has not begun."""
        return self._judges and self._ending_since is None

    def began_to_end(self, trainer: Trainer) -> bool:
        """Whether the final part begins after this epoch because the limit of epochs or minutes is near."""
        return self._ending_since == trainer.current_epoch + 1 and not self.converged

    def _active(self, module: LightningModule, data: ReadyDataModule) -> bool:
        schedule = cast(GausSimModule, module).settings.schedule
        falls_at_the_end = isinstance(schedule, StableDecaySchedule) and schedule.decay < 1
        return falls_at_the_end and data.curriculum.t_start <= data.curriculum.t_max - self._held_back

    def _apply(self, trainer: Trainer, module: LightningModule) -> None:
        curriculum = training_data(trainer).curriculum
        ending = self._ending_since
        cast(GausSimModule, module).progress_limit = 1 - _decay(module) if ending is None else 1.0
        curriculum.longest = curriculum.t_max - (self._held_back if ending is None else 0)
        if ending is not None and self.converged:
            length = math.ceil(ending / (1 - _decay(module)))
            trainer.fit_loop.max_epochs = min(self._allowance, length)

    def _judge(self, trainer: Trainer, module: GausSimModule, data: ReadyDataModule) -> Forecast:
        count, last = len(data.index), data.curriculum.t_max
        chosen = np.unique(np.linspace(0, count - 1, min(count, self._sequences)).round().astype(int)).tolist()
        samples = [data.training_sample(i, last).to(module.device) for i in chosen]
        return forecast(module, samples, last - self._held_back)

    # ------------------------------------------------------------------------------------------------ verdict

    @property
    def improvement(self) -> float | None:
        """Recent relative decrease of the best forecast's error in ten shows of a sequence; None while too few epochs.

        The best one is used because at constant rates the error fluctuates by a fifth from epoch to epoch.
        """
        length = max(1, math.ceil(self._window / self._shows))
        if len(self.forecasts) < 2 * length:
            return None
        errors = [f.error for f in self.forecasts]
        before, now = min(errors[:-length]), min(errors)
        if now <= 0 or before <= 0:  # as good as the reconstruction itself
            return 0.0
        return 1 - (now / before) ** (PER_SHOWS / (length * self._shows))

    def summary(self) -> dict[str, Any]:
        """Summary of the forecasts for a finished run; empty without forecasts."""
        if not self._judges:
            return {}
        lately = self.forecasts[-1] if self.forecasts else None
        found: dict[str, Any] = {"converged": self.converged, "cut_short": not self.converged}
        if lately is not None:
            found |= {"held_back_error": lately.error, "moving": lately.moving, "improvement": self.improvement}
        return {**found, "verdict": verdict(found)}

    def state_dict(self) -> dict[str, Any]:
        """The forecasts, and whether the final part has begun."""
        pairs = [[f.error, f.moving] for f in self.forecasts]
        return {"forecasts": pairs, "converged": self.converged, "ending_since": self._ending_since,
                "allowance": self._allowance}  # fmt: skip

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores the state."""
        self.forecasts = [Forecast(*pair) for pair in state_dict["forecasts"]]
        self.converged, self._ending_since = bool(state_dict["converged"]), state_dict["ending_since"]
        self._allowance = int(state_dict["allowance"])


@torch.no_grad()
def forecast(module: GausSimModule, samples: Sequence[SequenceSample], first: int) -> Forecast:
    """Errors of the predicted frames after ``first`` of all samples, each from its initial state."""
    loss = floor = static = 0.0
    try:
        with evaluating(module):
            for sample in samples:
                batch, hands, steps = module.simulator.batch([sample.scene_id]), module.hands([sample]), sample.steps
                initial = module.method.initial([sample], batch)
                _, made = next(windows(module.simulator, batch, initial, steps, steps, hands=hands))
                losses, _ = module.supervision.comparison([sample], batch)(States.of(made[first:]), first)
                baseline = module.baseline(sample)
                still = sum(baseline.static[first:steps])
                own = float(losses.sum())
                loss += own if math.isfinite(own) else 10.0 * still
                static, floor = static + still, floor + baseline.floor * (steps - first)
    except DivergenceError:
        return Forecast(10.0, 1.0)
    return Forecast(excess(loss, static, floor), (static - floor) / max(static, 1e-12))


def verdict(found: dict[str, Any]) -> str:
    """The result of a run's convergence in one or two sentences, with advice on further training."""
    error, moving, rate = found.get("held_back_error"), found.get("moving"), found.get("improvement")
    more = "The same command goes on from where the rates began to fall."
    if error is None or moving is None:
        return f"It was cut short before it could be judged. {more}"
    if moving < STILL:
        return (
            f"There is hardly anything to learn: of what the rest state misses in the frames held back, only "
            f"{max(0.0, moving):.0%} is motion, the rest it misses in frame 0 already. Either nothing moves, or scene, "
            "cameras and masks do not fit the videos: `gausim doctor ROOT` tells which."
        )
    came = f"on frames held back it leaves {error:.0%} of what a still object misses"
    if found["converged"]:
        if error > LITTLE:
            return (
                f"It has stopped learning and hardly foresees: {came}. More time would not help; `gausim doctor ROOT` "
                "looks for faults of the data."
            )
        return f"It has learned: {came}, and that no longer improves. More time would not help."
    if rate is None:
        return f"It was cut short before it could be told whether it had learned: {came}. {more}"
    if rate <= 0:
        return f"Its time ended: {came}, and that was no longer improving."
    return f"Its time ended while it was still improving {rate:.1%} per {PER_SHOWS} shows of a sequence: {came}. {more}"


def _decay(module: LightningModule) -> float:
    return float(cast(Any, module).settings.schedule.decay)
