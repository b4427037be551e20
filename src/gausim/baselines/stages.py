"""Stages of a fit, as data: learning rates, numbers of frames and losses."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from torch.nn import Parameter
from torch.optim import Optimizer

from gausim.core import ConfigError
from gausim.losses.image import ImageLoss
from gausim.nn.schedules import Schedule


@dataclass(frozen=True)
class Stage:
    """One stage of a fit.

    Attributes:
        iterations: optimiser steps for each sequence.
        rates: learning rate of each trained parameter group; the others stay constant.
        frames: predicted frames T at the beginning and at the end of the stage, linear between; 0 is the number of
            training frames.
        schedules: learning-rate schedules by group, counted in iterations of the stage; ``default`` is for the groups
            that are not named.
        penalties: weights of the method's penalties, by name.
        backprop_steps: loss gradients stop after this number of frames; 0 lets them through the whole rollout.
        clip_norm: largest norm of all loss gradients together; 0 does not clip.
        original: iterations of the published method; tables mark a stage that has fewer. 0 is unknown.
    """

    iterations: int
    rates: Mapping[str, float]
    loss: ImageLoss
    frames: Sequence[int] = (0, 0)
    schedules: Mapping[str, Schedule] = field(default_factory=dict)
    penalties: Mapping[str, float] = field(default_factory=dict)
    backprop_steps: int = 1
    clip_norm: float = 1.0
    original: int = 0

    def __post_init__(self) -> None:
        if self.iterations < 1 or not self.rates or min(self.rates.values()) <= 0:
            raise ConfigError(
                "model.plan.stages: expected iterations >= 1 and rates > 0 for at least one group, got "
                f"{self.iterations} and {dict(self.rates)}. To leave a stage out, set it to null."
            )
        if len(self.frames) != 2 or min(self.frames) < 0 or min(self.clip_norm, self.backprop_steps) < 0:
            raise ConfigError(
                "model.plan.stages: expected frames as two numbers >= 0, and clip_norm, backprop_steps >= 0, got "
                f"{list(self.frames)}, {self.clip_norm} and {self.backprop_steps}."
            )

    def steps(self, done: float, most: int) -> int:
        """Predicted frames T after a fraction ``done`` of the stage; ``most`` is the number of training frames."""
        first, last = (most if n == 0 else min(n, most) for n in self.frames)
        return first + round((last - first) * min(1.0, max(0.0, done)))

    def rate(self, group: str, iteration: float) -> float:
        """Learning rate of a group after ``iteration`` iterations of the stage; 0 where it is not trained."""
        schedule = self.schedules.get(group, self.schedules.get("default"))
        factor = 1.0 if schedule is None else schedule.factor(iteration, self.iterations)
        return self.rates.get(group, 0.0) * factor


@dataclass(frozen=True)
class FitPlan:
    """The stages of a method, one after the other.

    Attributes:
        stages: stages by name; null leaves one out. Without stages there is no training.
        round: iterations of every sequence per epoch (a row of epochs.csv, a checkpoint, a change of stage or of T);
            fewer where a stage has fewer.
        optimizer: constructor of the optimiser from parameter groups; Adam when None.
    """

    stages: Mapping[str, Stage | None] = field(default_factory=dict)
    round: int = 5
    optimizer: Callable[..., Optimizer] | None = None

    def __post_init__(self) -> None:
        if self.round < 1:
            raise ConfigError(f"model.plan.round: expected at least 1 iteration, got {self.round}.")

    @property
    def order(self) -> list[tuple[str, Stage]]:
        """The stages in their order, without those left out."""
        return [(name, stage) for name, stage in self.stages.items() if stage is not None]

    @property
    def shows(self) -> int:
        """Iterations of every sequence per epoch."""
        return min([self.round, *(stage.iterations for _, stage in self.order)])

    @property
    def epochs(self) -> int:
        """Epochs of the whole plan."""
        return sum(self._epochs(stage) for _, stage in self.order)

    def _epochs(self, stage: Stage) -> int:
        return max(1, round(stage.iterations / self.shows))

    def check(self, groups: Mapping[str, Sequence[Parameter]], penalties: Sequence[str]) -> None:
        """Raises ConfigError where a stage names a group or penalty that a method does not have."""
        for name, stage in self.order:
            for what, asked, there in (("rates", stage.rates, groups), ("penalties", stage.penalties, penalties)):
                unknown = sorted(set(asked) - set(there))
                if unknown:
                    raise ConfigError(
                        f"model.plan.stages.{name}.{what}: {unknown} asked for; the method has {sorted(there)}."
                    )

    def place(self, epochs: float) -> tuple[str, Stage, float]:
        """The stage after ``epochs`` epochs of the plan, its name, and the iterations of it that are done."""
        rest, order = epochs, self.order
        while len(order) > 1 and rest >= self._epochs(order[0][1]):  # a budget may run a little beyond the last
            rest -= self._epochs(order.pop(0)[1])
        name, stage = order[0]
        return name, stage, min(float(stage.iterations), rest * self.shows)

    def steps(self, epochs: float, most: int) -> int:
        """Predicted frames T after ``epochs`` epochs of the plan; ``most`` is the number of training frames."""
        _, stage, done = self.place(epochs)
        return stage.steps(done / max(1.0, stage.iterations - self.shows), most)
