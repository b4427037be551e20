"""Hands that move the pins of an object: as recorded, until a user takes them over."""

from functools import lru_cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core import ConfigError, GaussianScene, HandPose, Hands
from gausim.interaction.session import Hand
from gausim.ops.rotation import rotation_of, rotation_vector


def hand_of(scene: GaussianScene) -> Int[Tensor, " K"]:
    """The hand that holds each kernel, -1 for none; without recorded hands one hand holds all pins."""
    return torch.where(scene.pinned, 0, -1) if scene.hand is None else scene.hand


class MovedHands:
    """Poses of an object's hands by frame, from the events so far; each motion begins and ends at rest."""

    def __init__(self, scene: GaussianScene, recorded: Hands | None = None) -> None:
        """Begins with all hands at rest, or following their recorded poses."""
        hand = hand_of(scene)
        self._origins = torch.stack([scene.means[hand == number].mean(0) for number in range(int(hand.max()) + 1)])
        self._recorded = recorded
        # Of every hand that a user moves: the frame at which that begins, its duration, where from and where to.
        self._motions: dict[int, tuple[int, int, Tensor, Tensor]] = {}
        self._past: dict[int, Tensor] = {}  # places before the latest event, for which its next step still asks
        # A step asks for three poses, of which the next one asks for two again.
        self.pose = lru_cache(4)(self._pose)

    @property
    def count(self) -> int:
        """Number of hands."""
        return len(self._origins)

    def move(self, event: Hand, frame: int) -> None:
        """Lets a hand begin to move at a frame, from where it is.

        Raises:
            ConfigError: the object has no such hand.
        """
        if event.hand >= self.count:
            raise ConfigError(f"field 'hand': expected 0 to {self.count - 1}, got {event.hand}.")
        self._past = {number: self.places(number) for number in (frame - 1, frame)}
        goal = torch.tensor((*event.to, *event.turn), dtype=torch.float64)
        self._motions[event.hand] = frame, event.frames, self._past[frame][event.hand], goal
        self.pose.cache_clear()

    def places(self, frame: int) -> Float[Tensor, "G 6"]:
        """Displacement of the middle of every hand's pins from rest [scene units], and rotation vector [radian]."""
        if frame in self._past:
            return self._past[frame]
        found = self._followed(frame)
        for hand, (begin, frames, start, goal) in self._motions.items():
            part = min((frame - begin) / frames, 1.0)
            found[hand] = start + (goal - start) * (part * part * (3 - 2 * part))
        return found

    def _followed(self, frame: int) -> Float[Tensor, "G 6"]:
        """The places that were recorded; zeros without a recording."""
        pose = None if self._recorded is None else self._recorded(frame)
        if pose is None:
            return torch.zeros(self.count, 6, dtype=torch.float64)
        pose, middles = pose.to(self._origins.double()), self._origins.double()
        moved = pose.move(middles, torch.arange(self.count, device=middles.device)) - middles
        turned = torch.stack([rotation_vector(rotation) for rotation in pose.rotations[: self.count]])
        return torch.cat((moved, turned), 1)

    def _pose(self, frame: int) -> HandPose | None:
        """The pose at a frame."""
        if self._recorded is not None and not self._motions:
            return self._recorded(frame)
        now = self.places(frame)
        return HandPose(rotation_of(now[:, 3:]), self._origins, self._origins + now[:, :3]).to(self._origins)
