"""Curriculum of training: the number of predicted steps per epoch."""

from __future__ import annotations

from dataclasses import dataclass, field

from gausim.core import ConfigError


@dataclass
class Curriculum:
    """T grows by one every few epochs up to ``t_max`` (METHOD section 4)."""

    t_start: int = 1  # predicted steps in epoch 0
    t_max: int = 15  # most predicted steps; 15 steps use frames 0..15 and no unseen one
    epochs_per_increase: int = 1  # epochs between increases
    # current limit of predicted steps, at most ``t_max``; the convergence test lowers it to hold frames back
    longest: int = field(default=0, init=False, repr=False)
    # whether rollouts are as long as possible from epoch 0 on, because training starts near the motion in the videos
    grown: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        """Checks the bounds."""
        if not 1 <= self.t_start <= self.t_max or self.epochs_per_increase < 1:
            raise ConfigError(f"curriculum: expected 1 <= t_start <= t_max and epochs_per_increase >= 1, got {self}.")
        self.longest = self.t_max

    def steps(self, epoch: int) -> int:
        """Predicted steps T in an epoch (counted from 0)."""
        if self.grown:
            return self.longest
        return min(self.longest, self.t_start + epoch // self.epochs_per_increase)
