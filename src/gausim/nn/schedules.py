"""Learning-rate schedules: a factor on the rates by the part of a training that is done."""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from gausim.core import ConfigError


@runtime_checkable
class Schedule(Protocol):
    """Factor on learning rates."""

    def factor(self, done: float, total: float) -> float:
        """The factor after ``done`` of ``total`` epochs or iterations."""


@dataclass(frozen=True)
class HalvingSchedule:
    """Halves the rates after ``first`` epochs (iterations) and then every ``every`` (METHOD section 4)."""

    first: int = 16
    every: int = 2

    def factor(self, done: float, total: float) -> float:
        """A power of one half."""
        whole = math.floor(done)
        return 1.0 if whole < self.first else 0.5 ** (1 + (whole - self.first) // self.every)


@dataclass(frozen=True)
class CosineSchedule:
    """A linear warm-up, constant rates, and a half-cosine decay.

    Attributes:
        warmup: length of the warm-up [epochs].
        decay: last fraction of the training over which the rates fall; 1: from its start.
        final: factor at the end.
    """

    warmup: float = 1.0
    decay: float = 1.0
    final: float = 0.05

    def __post_init__(self) -> None:
        if self.warmup < 0 or not 0 < self.decay <= 1 or not 0 <= self.final <= 1:
            raise ConfigError(f"plan.schedule: expected warmup >= 0, 0 < decay <= 1 and final in [0, 1], got {self}.")

    def factor(self, done: float, total: float) -> float:
        """A factor between ``final`` and 1, and from 0.05 on in the warm-up."""
        if done < self.warmup:
            return max(0.05, done / self.warmup)
        fraction = (min(1.0, done / max(1, total)) - 1 + self.decay) / self.decay
        return self.final + (1 - self.final) * 0.5 * (1 + math.cos(math.pi * max(0.0, fraction)))


@dataclass(frozen=True)
class ExponentialSchedule:
    """Exponential decay to the factor ``final`` at the end."""

    final: float = 0.1

    def factor(self, done: float, total: float) -> float:
        """Between ``final`` and 1."""
        return float(self.final ** min(1.0, done / max(1, total)))


@dataclass(frozen=True)
class LinearSchedule:
    """Linear decay to the factor ``final`` at the end."""

    final: float = 0.0

    def factor(self, done: float, total: float) -> float:
        """Between ``final`` and 1."""
        return 1.0 + (self.final - 1.0) * min(1.0, done / max(1, total))
