"""What acts on a body besides its own elasticity: gravity, a floor, and hands that move its pins."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core.errors import ConfigError

# Smallest over largest spread of a hand's points below which they fix no rotation.
FLAT = 1e-3


@dataclass(frozen=True)
class Floor:
    """A half space that the body cannot enter; the body is on the side of the normal."""

    point: tuple[float, float, float]  # a point of the plane [scene units]
    normal: tuple[float, float, float]  # unit vector out of the floor
    friction: float | None = None  # Coulomb's coefficient; None: trained
    restitution: float | None = None  # speed after over speed before an impact of a contact point, 0..1; None: trained

    def height(self, positions: Float[Tensor, "*N 3"]) -> Float[Tensor, " *N"]:
        """Signed distance from the plane [scene units], negative below it."""
        return (positions - positions.new_tensor(self.point)) @ positions.new_tensor(self.normal)


@dataclass(frozen=True)
class Surroundings:
    """Surroundings of a scene."""

    free: bool = False  # nothing holds the body: it moves as a whole, and no kernel needs to be pinned
    # acceleration [scene units / s^2]; None: none. A body at rest in its pins is in equilibrium with it
    gravity: tuple[float, float, float] | None = None
    trains_gravity: bool = False  # gravity is trained, beginning at ``gravity`` or zero
    floor: Floor | None = None  # the floor, if there is one

    @property
    def still(self) -> bool:
        """Whether the body stays at rest in its pins if nobody moves them."""
        return not self.free and self.floor is None


@dataclass(frozen=True, eq=False)
class HandPose:
    """Rigid motion of G hands from the rest state: X goes to R (X - o) + c."""

    rotations: Float[Tensor, "G 3 3"]  # R
    origins: Float[Tensor, "G 3"]  # o [scene units]
    centres: Float[Tensor, "G 3"]  # c [scene units]

    def move(self, points: Float[Tensor, "N 3"], hand: Int[Tensor, " N"]) -> Float[Tensor, "N 3"]:
        """Rest points after the motion of the hand that holds each."""
        offset = points - self.origins.index_select(0, hand)
        turned = (self.rotations.index_select(0, hand) @ offset[..., None])[..., 0]
        return self.centres.index_select(0, hand) + turned

    def to(self, like: Tensor) -> "HandPose":
        """The same pose on the device and in the precision of a tensor."""
        return HandPose(self.rotations.to(like), self.origins.to(like), self.centres.to(like))


@dataclass(frozen=True, eq=False)
class HandPath:
    """Recorded motion of G hands over F frames, relative to frame 0, where they hold the body at rest."""

    rotations: Float[Tensor, "F G 3 3"]
    centres: Float[Tensor, "F G 3"]  # [scene units]

    @staticmethod
    def of(points: Float[Tensor, "F C 3"], hand: Int[Tensor, " C"]) -> "HandPath":
        """The best rigid motion (Kabsch) of each hand's points; a translation where they fix no rotation.

        Raises:
            ConfigError: a hand between 0 and the largest index has no point.
        """
        rotations, centres = [], []
        for number in range(int(hand.max()) + 1):
            own = points[:, hand == number].double()
            if not own.shape[1]:
                raise ConfigError(
                    f"hands: hand {number} has no point; expected hands 0..{int(hand.max())} to have some."
                )
            centre = own.mean(1)
            offset = own - centre[:, None]
            turned = torch.eye(3, dtype=own.dtype).expand(len(own), 3, 3)
            if own.shape[1] > 2:
                spread = torch.linalg.svdvals(offset[0])
                turned = best_rotation(offset, offset[0]) if spread[1] > FLAT * spread[0] else turned
            rotations.append(turned)
            centres.append(centre)
        return HandPath(torch.stack(rotations, 1).float(), torch.stack(centres, 1).float())

    @property
    def frames(self) -> int:
        """Number of frames F."""
        return len(self.centres)

    def pose(self, frame: int) -> HandPose:
        """The pose at a frame; after the last one the hands stand still, before frame 0 they move as after it.

        A frame has one pose object, by which what follows from it is found again.
        """
        return self._poses[min(max(frame, -1), self.frames - 1) + 1]

    @cached_property
    def _poses(self) -> tuple[HandPose, ...]:
        """The poses of frames -1, 0, ..., F - 1."""
        second = min(1, self.frames - 1)
        before = HandPose(self.rotations[second].mT, self.centres[0], 2 * self.centres[0] - self.centres[second])
        recorded = zip(self.rotations, self.centres, strict=True)
        return before, *(HandPose(rotation, self.centres[0], centre) for rotation, centre in recorded)


def best_rotation(moved: Float[Tensor, "*F C 3"], rest: Float[Tensor, "C 3"]) -> Float[Tensor, "*F 3 3"]:
    """The rotation R that minimises sum |R rest - moved|^2 of points about their means (Kabsch 1976)."""
    u, _, vt = torch.linalg.svd(moved.mT @ rest)
    sign = torch.ones_like(u[..., 0])
    sign[..., 2] = torch.linalg.det(u @ vt)
    return (u * sign[..., None, :]) @ vt
