"""Curriculum of training: the number of predicted steps per epoch."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from gausim.core import ConfigError

# Predicted steps to which T grows by one at an increase, and the most that are chosen for longer videos: the memory and
# the time of an optimiser step grow with T.
USUAL, MOST = 15, 60


@dataclass
class Curriculum:
    """T grows every few epochs up to ``t_max`` (METHOD section 4): by one, or by more where videos are long."""

    t_start: int = 1  # predicted steps in epoch 0
    t_max: int = USUAL  # most predicted steps; 15 use frames 0..15 and no unseen one; 0: all seen frames, at most MOST
    epochs_per_increase: int = 1  # epochs between increases
    # most predicted steps, once the seen frames are known
    longest: int = field(default=0, init=False, repr=False)
    # whether rollouts are as long as possible from epoch 0 on, because training starts near the motion in the videos
    grown: bool = field(default=False, init=False, repr=False)
    # steps that an increase adds
    increase: int = field(default=1, init=False, repr=False)

    def __post_init__(self) -> None:
        """Checks the bounds."""
        if self.t_start < 1 or 0 < self.t_max < self.t_start or self.t_max < 0 or self.epochs_per_increase < 1:
            raise ConfigError(
                f"curriculum: expected 1 <= t_start <= t_max, or t_max=0, and epochs_per_increase >= 1, got {self}."
            )
        self.longest = self.t_max

    def see(self, frames: int) -> None:
        """Where t_max is 0, takes it from the number of seen frames; T grows to it in as many epochs as to 15."""
        if not self.t_max:
            self.longest = self.t_max = max(1, min(frames - 1, MOST))
            self.t_start = min(self.t_start, self.t_max)
            self.increase = max(1, math.ceil((self.t_max - self.t_start) / max(1, USUAL - self.t_start)))

    def steps(self, epoch: int) -> int:
        """Predicted steps T in an epoch (counted from 0)."""
        if self.grown:
            return self.longest
        return min(self.longest, self.t_start + self.increase * (epoch // self.epochs_per_increase))
