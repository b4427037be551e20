"""The stages in which a method is fitted, as data: what learns how fast, on how many frames, by which loss."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from torch.nn import Parameter
from torch.optim import Adam, Optimizer

from gausim.core import ConfigError
from gausim.data.curriculum import Curriculum
from gausim.losses.image import ImageLoss
from gausim.training.optimizers import Schedule


@dataclass(frozen=True)
class Stage:
    """One stage.

    Attributes:
        iterations: optimiser steps for each sequence.
        rates: learning rate of each parameter group that learns; the others rest.
        frames: predicted frames T at the beginning and at the end of the stage, growing evenly between; 0 is as many
            as training may see.
        schedules: how the rates of a group change, counted in iterations of the stage; ``default`` is for the groups
            that are not named.
        penalties: weights of what the method offers to be minimised besides, by name.
        backprop_steps: gradients stop every so many frames; 0 lets them through the whole rollout.
        clip_norm: all gradients together are clipped at this norm; 0 does not clip.
        original: iterations of the published method at least; where there are fewer here, tables say so. 0: not known.
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
        """Predicted frames T after a fraction ``done`` of the stage; ``most`` is what training may see."""
        first, last = (most if n == 0 else min(n, most) for n in self.frames)
        return first + round((last - first) * min(1.0, max(0.0, done)))

    def rate(self, group: str, iteration: float) -> float:
        """Learning rate of a group (0 where it rests) after so many iterations of the stage."""
        schedule = self.schedules.get(group, self.schedules.get("default"))
        factor = 1.0 if schedule is None else schedule.factor(iteration, self.iterations)
        return self.rates.get(group, 0.0) * factor


@dataclass(frozen=True)
class FitPlan:
    """The stages of a method, one after the other.

    Attributes:
        stages: by name; null leaves one out. None at all: nothing is learned.
        round: iterations of every sequence between two looks (rows of epochs.csv, checkpoints, a change of stage or
            of T); fewer where a stage has fewer.
        optimizer: makes the optimiser from parameter groups; Adam when None.
    """

    stages: Mapping[str, Stage | None] = field(default_factory=dict)
    round: int = 5
    optimizer: Callable[..., Optimizer] | None = None

    def __post_init__(self) -> None:
        if self.round < 1:
            raise ConfigError(f"model.plan.round: expected at least 1 iteration, got {self.round}.")

    @property
    def order(self) -> list[tuple[str, Stage]]:
        """The stages that are made."""
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

    def build(self, groups: Mapping[str, Sequence[Parameter]]) -> Optimizer | None:
        """One optimiser over all groups; None where nothing learns."""
        made = [{"params": list(members), "lr": 0.0, "name": name} for name, members in groups.items() if members]
        return (self.optimizer or Adam)(made) if made and self.order else None

    def place(self, epochs: float) -> tuple[str, Stage, float]:
        """The stage after so many epochs of the plan, and the iterations of it that lie behind."""
        rest, order = epochs, self.order
        while len(order) > 1 and rest >= self._epochs(order[0][1]):  # a budget may run a little beyond the last
            rest -= self._epochs(order.pop(0)[1])
        name, stage = order[0]
        return name, stage, min(float(stage.iterations), rest * self.shows)


@dataclass
class StagedCurriculum(Curriculum):
    """T as the stages have it: set by :meth:`enter` before every epoch; ``t_max`` is what training may see.

    Attributes:
        plan: the stages.
    """

    plan: FitPlan = field(default_factory=FitPlan)
    _state: dict[str, float] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.enter(0.0)

    @property
    def position(self) -> float:
        """Where in the plan the epoch under way began [epochs of the plan]."""
        return self._state["position"]

    def enter(self, position: float) -> None:
        """Fixes stage and T of the next epoch."""
        steps = self.t_max
        if self.plan.order:
            _, stage, done = self.plan.place(position)
            steps = stage.steps(done / max(1.0, stage.iterations - self.plan.shows), self.t_max)
        self._state.update(position=position, steps=float(steps))

    def steps(self, epoch: int) -> int:
        """Predicted steps T of the epoch under way; its number does not matter."""
        return int(self._state["steps"])

    def state_dict(self) -> dict[str, float]:
        """Where in the plan."""
        return dict(self._state)

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        """Continues where ``state`` was taken."""
        self._state.update(state)
