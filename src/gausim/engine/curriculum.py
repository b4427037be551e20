"""A curriculum that lengthens the rollout when the loss allows it, not by the clock alone."""

from __future__ import annotations

from dataclasses import dataclass, field

from gausim.core import ConfigError
from gausim.data.curriculum import Curriculum


@dataclass(frozen=True)
class LossGatedCurriculum(Curriculum):
    """T grows by one after an epoch whose loss is below a fraction of the static prediction's, or out of patience.

    Loss and static loss are counted above the floor that the reconstruction itself leaves on frame 0. Raised by the
    clock, T runs ahead of what the network can do and its rollouts collapse to the rest state.

    Attributes:
        threshold: the fraction.
        patience: epochs at one T after which it grows all the same; 0 waits for ever.
    """

    threshold: float = 0.5
    patience: int = 10
    _state: dict[str, int] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Checks the bounds; ``epochs_per_increase`` is the least number of epochs at one T."""
        super().__post_init__()
        if self.threshold <= 0 or self.patience < 0:
            raise ConfigError(f"curriculum: expected threshold > 0 and patience >= 0, got {self}.")
        self._state.update(steps=self.t_start, epochs=0)

    def steps(self, epoch: int) -> int:
        """Predicted steps T now; the epoch's number does not matter."""
        return self._state["steps"]

    def observe(self, ratio: float) -> bool:
        """Takes the ratio of an epoch that is over; returns whether T grew."""
        self._state["epochs"] += 1
        waited = self._state["epochs"]
        due = ratio < self.threshold and waited >= self.epochs_per_increase
        if not (due or 0 < self.patience <= waited) or self._state["steps"] >= self.t_max:
            return False
        self._state.update(steps=self._state["steps"] + 1, epochs=0)
        return True

    def state_dict(self) -> dict[str, int]:
        """T and the epochs spent at it."""
        return dict(self._state)

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Continues where ``state`` was taken."""
        self._state.update(steps=int(state["steps"]), epochs=int(state["epochs"]))
