"""Dragging a pin: the hand that holds it goes where the pointer goes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gausim.interaction.interaction import Interaction
from gausim.interaction.session import Hand

# Time in which a hand follows the pointer or its slider [s].
HAND_SECONDS = 0.15


@dataclass
class Grab:
    """A hand that a pointer drags, from the beginning of the drag."""

    hand: int  # its number
    point: Tensor  # where the drag began (3,) [page units]
    scale: float  # page units per scene unit
    # called with the hand and its displacement from rest [scene units]
    moved: Callable[[int, tuple[float, float, float]], None]
    # Displacement and turn of the hand when the drag began; asked for by the simulation's thread at the first motion.
    _place: tuple[Tensor, tuple[float, float, float]] | None = None

    def drag(self, end: Any) -> Tensor:
        """The way from the beginning of the drag to a point of the page (3,) [scene units]."""
        return (torch.tensor([float(v) for v in end]) - self.point) / self.scale

    def event(self, interaction: Interaction, end: Any) -> Hand:
        """The motion of the hand to a point of the page; it keeps the turn that it had."""
        if self._place is None:
            to, turn = interaction.place_of_hand(self.hand)
            self._place = torch.tensor(to), turn
        start, turn = self._place
        x, y, z = (start + self.drag(end)).tolist()
        self.moved(self.hand, (x, y, z))
        return Hand((x, y, z), max(1, round(HAND_SECONDS * interaction.fps)), turn, self.hand)
