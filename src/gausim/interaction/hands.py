"""Hands that move the pins of an object as a user says."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import ConfigError, GaussianScene, HandPose
from gausim.interaction.session import Hand
from gausim.ops.rotation import rotation_of


class MovedHands:
    """Poses of an object's hands by frame, from the events so far; each motion begins and ends at rest."""

    def __init__(self, scene: GaussianScene) -> None:
        """Begins with all hands at rest."""
        hand = torch.where(scene.pinned, 0, -1) if scene.hand is None else scene.hand
        count = int(hand.max()) + 1
        self._origins = torch.stack([scene.means[hand == number].mean(0) for number in range(count)])
        # Per event: the frame at which it begins, its duration, its hand, and where that comes from and goes to.
        self._motions: list[tuple[int, int, int, Tensor, Tensor]] = []

    @property
    def count(self) -> int:
        """Number of hands."""
        return len(self._origins)

    def move(self, event: Hand, frame: int) -> None:
        """Lets a hand begin to move at a frame.

        Raises:
            ConfigError: the object has no such hand.
        """
        if event.hand >= self.count:
            raise ConfigError(f"field 'hand': expected 0 to {self.count - 1}, got {event.hand}.")
        goal = torch.tensor((*event.to, *event.turn))
        self._motions.append((frame, event.frames, event.hand, self._at(frame)[event.hand], goal))

    def _at(self, frame: int) -> Float[Tensor, "G 6"]:
        """Displacement and rotation vector of every hand."""
        found = torch.zeros(self.count, 6)
        for begin, frames, hand, start, goal in self._motions:
            if frame >= begin:
                part = min((frame - begin) / frames, 1.0)
                found[hand] = start + (goal - start) * (part * part * (3 - 2 * part))
        return found

    def pose(self, frame: int) -> HandPose:
        """The pose at a frame."""
        now = self._at(frame)
        return HandPose(rotation_of(now[:, 3:]), self._origins, self._origins + now[:, :3].to(self._origins))
