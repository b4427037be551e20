"""The training plan: the only place that decides epochs, T, learning-rate factors, the first stages and the end."""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from gausim.core import ConfigError
from gausim.nn.schedules import CosineSchedule, HalvingSchedule, Schedule

# Epochs where T is largest from the beginning, with 95 % of the gain over the static prediction, and where T grows;
# predicted frames in the first epoch then.
WARM_EPOCHS, COLD_EPOCHS, FIRST = 10, 60, 2
# Predicted frames to which T grows by one at an increase, and the most that are chosen for longer videos: memory and
# time of an optimiser step grow with T.
USUAL, LONGEST = 15, 60

SCHEDULES: dict[str, Schedule] = {"cosine": CosineSchedule(), "halving": HalvingSchedule()}


@dataclass(frozen=True)
class WarmStart:
    """A fit of initial states, densities, attributes and template to tracked motion, before the first optimiser step.

    Attributes:
        updates: updates of the fit. Longer rollouts than of 15 frames get fewer, for the same cost.
        growing: fraction of the updates over which T grows to its largest. The fit keeps its best at that T: the
            earlier it is reached, the less harm is done by an update that leads astray.
        decay: weight decay of the attributes in the fit, decoupled; without it, long fits follow the errors of the
            tracks.
        sequences: most sequences of an object in one update.
        scene_lr: learning rate of densities and attributes in the fit.
        template_lr: that of the template.
        initial_lr: that of the initial states.
        rate_factor: factor on the learning rates of scenes, template and initial states in the training that follows,
            which starts near the solution.
    """

    updates: int = 300
    growing: ClassVar[float] = 0.25
    decay: ClassVar[float] = 0.05
    sequences: ClassVar[int] = 12
    scene_lr: ClassVar[float] = 0.1
    template_lr: ClassVar[float] = 1e-2
    initial_lr: ClassVar[float] = 2e-3
    rate_factor: ClassVar[float] = 0.2

    def __post_init__(self) -> None:
        if self.updates < 1:
            raise ConfigError(
                f"plan.warm_start.updates: expected at least 1, got {self.updates}. Without a warm start it is null."
            )


@dataclass(frozen=True)
class Teaching:
    """Training on tracked motion before the first optimiser step: single steps, then rollouts on the tracks.

    A show is all seen frames of a sequence. The rates are those of the optimiser, falling in each part.

    Attributes:
        shows: shows of each sequence in single steps.
        rolls: shows of each sequence in rollouts, T growing from 2 to all seen frames.
        sums: fraction of the lessons that are on sums of two motions of a body, of random sizes.
        noise: deviation of the noise of every unit in single steps, of its velocity half as much per frame [diagonals].
        roll_factor: factor on the learning rates in the rollouts.
        rate_factor: factor on all learning rates in the training that follows.
    """

    shows: int = 60
    rolls: int = 60
    sums: float = 0.5
    noise: float = 1e-3
    roll_factor: ClassVar[float] = 0.2
    rate_factor: ClassVar[float] = 0.2

    def __post_init__(self) -> None:
        if min(self.shows, self.rolls) < 0 or self.shows + self.rolls < 1 or not self.noise >= 0:
            raise ConfigError(
                "plan.teach: expected shows and rolls of at least 0, one of them more, and noise >= 0, got "
                f"{self.shows}, {self.rolls} and {self.noise}. Without teaching it is null."
            )
        if not 0 <= self.sums <= 1:
            raise ConfigError(f"plan.teach.sums: expected 0 to 1, got {self.sums}.")


@dataclass(frozen=True)
class DataFacts:
    """What a plan needs to know of the data."""

    sequences: int  # to train on
    frames: int  # seen frames, of the object that has fewest
    can_warm_start: bool  # whether the motion can be tracked: no body is free, none is above a floor
    can_teach: bool | None = None  # and no body is in hands; None: as ``can_warm_start``
    free: bool = False  # whether bodies are free, whose first frames are known from their silhouettes


@dataclass(frozen=True)
class TrainingPlan:
    """The course of a training, by the configuration's node ``plan``.

    Null values follow from the data; :meth:`resolved` sets them, and the saved configuration of a run states them.

    Attributes:
        epochs: epochs of the training; None: 10 where T is largest from the beginning, else 60.
        repeats: shows of each sequence per epoch.
        batch_size: sequences per optimiser step, divided among the ranks; None: a third of all, 1 to 4.
        t_start: predicted frames T in epoch 0; None: ``t_max`` after a warm start and for free bodies, of which short
            rollouts show no deformation, else 2.
        t_max: most predicted frames; None: all seen frames, at most 60.
        schedule: factor on all learning rates by the part that is done: ``cosine``, ``halving`` (METHOD section 4) or
            another schedule; None: constant.
        warm_start: the fit before the first step; None: training starts from rest and a material at random. It is left
            out where bodies are free or above a floor, and where they are in hands and compared with true points.
        teach: the network's training on tracked motion after it, left out likewise and for all bodies in hands; None:
            the network starts at random.
        max_minutes: limit of the training time, resumed runs included; the rates then follow the time, too.
        clock: ``wall``, or ``cpu`` for the processor time of this process.
    """

    epochs: int | None = None
    repeats: int = 4
    batch_size: int | None = None
    t_start: int | None = None
    t_max: int | None = None
    schedule: Schedule | str | None = "cosine"
    warm_start: WarmStart | None = WarmStart()
    teach: Teaching | None = None
    max_minutes: float | None = None
    clock: str = "wall"

    def __post_init__(self) -> None:
        counts = ("epochs", "repeats", "batch_size", "t_start", "t_max")
        for name in counts:
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"plan.{name}: expected at least 1, got {value}.")
        if self.t_start is not None and self.t_max is not None and self.t_start > self.t_max:
            raise ConfigError(f"plan: expected t_start <= t_max, got {self.t_start} and {self.t_max}.")
        if isinstance(self.schedule, str) and self.schedule not in SCHEDULES:
            raise ConfigError(f"plan.schedule: expected {', '.join(SCHEDULES)} or null, got '{self.schedule}'.")
        if self.clock not in ("wall", "cpu") or (self.max_minutes is not None and not self.max_minutes > 0):
            raise ConfigError(
                f"plan: expected max_minutes > 0 or null and clock wall or cpu, got {self.max_minutes}, {self.clock!r}."
            )

    # ------------------------------------------------------------------------------------------------ resolution

    def resolved(self, data: DataFacts, *, ranks: int = 1) -> "TrainingPlan":
        """The plan for some data, without None in epochs, T and batch size; a resolved plan stays as it is.

        Raises:
            ConfigError: ``t_max`` is beyond the seen frames.
        """
        warm = self.warm_start if data.can_warm_start else None
        teach = self.teach if (data.can_warm_start if data.can_teach is None else data.can_teach) else None
        t_max = max(1, min(data.frames - 1, LONGEST)) if self.t_max is None else self.t_max
        if t_max >= data.frames:
            raise ConfigError(
                f"plan.t_max: {t_max} predicted frames would see frame {t_max}, but training sees frames "
                f"0..{data.frames - 1}; expected at most {data.frames - 1}."
            )
        begun = bool(warm or teach or data.free)
        t_start = self.t_start or (t_max if begun else min(FIRST, t_max))
        return replace(
            self,
            warm_start=warm,
            teach=teach,
            t_max=t_max,
            t_start=t_start,
            epochs=self.epochs or (WARM_EPOCHS if begun and t_start == t_max else COLD_EPOCHS),
            batch_size=self.batch_size or max(ranks, min(4, data.sequences // 3)),
        )

    def settings(self) -> dict[str, Any]:
        """The keys of the node ``plan`` that :meth:`resolved` decides."""
        found = {name: getattr(self, name) for name in ("epochs", "batch_size", "t_start", "t_max")}
        return {**found, **{name: None for name in ("warm_start", "teach") if getattr(self, name) is None}}

    # ------------------------------------------------------------------------------------------------ course

    def steps(self, epoch: int) -> int:
        """Predicted frames T in an epoch, counted from 0; T grows to 15 and to more in equally many epochs."""
        assert self.t_start is not None and self.t_max is not None, "expected a resolved plan"
        increase = max(1, math.ceil((self.t_max - self.t_start) / max(1, USUAL - self.t_start)))
        return min(self.t_max, self.t_start + increase * epoch)

    def time_fraction(self, minutes: float) -> float:
        """The part of the time limit that is used after some minutes of training; 0 without a limit."""
        return 0.0 if self.max_minutes is None else min(1.0, minutes / self.max_minutes)

    def progress(self, epochs: float, minutes: float = 0.0) -> float:
        """The part of the training that is done after some epochs and minutes, at most 1."""
        return min(1.0, max(epochs / (self.epochs or 1), self.time_fraction(minutes)))

    def rate_factor(self, group: str, progress: float) -> float:
        """The factor on the learning rate of a parameter group at a part of the training.

        After a warm start all but the network have lower rates, after teaching all have.
        """
        epochs = self.epochs or 1
        schedule = SCHEDULES[self.schedule] if isinstance(self.schedule, str) else self.schedule
        factor = 1.0 if schedule is None else schedule.factor(round(progress * epochs, 9), epochs)
        if self.teach is not None:
            return factor * self.teach.rate_factor
        return factor if self.warm_start is None or group == "network" else factor * self.warm_start.rate_factor
