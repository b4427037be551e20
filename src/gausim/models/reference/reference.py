"""The reference configuration of a body that moves as a whole or in hands, and the step relative to it.

Everything that the simulator learns happens relative to a reference configuration. For a body in fixed pins it is
the rest state. For one that moves it is carried along (the floating frame of reference of multibody dynamics, Shabana
2020): unit n has the reference position a_n, rotation B_n and deformation gradient A_n, and the simulator sees

    y_n = X_n + B_n^T (x_n - a_n)

at t - 1 and t, and a load: the inertial acceleration of the reference, gravity, and the strain of the reference. Its
prediction y, G, Q of the kernels at t + 1 goes back to

    x_k = a_c + A_c (X_k - X_c) + B_c (y_k - X_k),   A_c + B_c (G_c - I),   B_c Q_c.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import HandPose, Hands, SimState
from gausim.models.hierarchy.batch import Member, SceneBatch
from gausim.models.reference.placed import Placed


class HandMotion(NamedTuple):
    """Poses of a body's hands in the three frames of a step; None where they are at rest."""

    before: HandPose | None
    now: HandPose | None
    after: HandPose | None


def hand_motion(hands: Hands | None, frame: int) -> HandMotion | None:
    """Poses of the step from ``frame`` to the next; None without hands."""
    return None if hands is None else HandMotion(hands(frame - 1), hands(frame), hands(frame + 1))


@dataclass(frozen=True, eq=False)
class UnitMotion:
    """Finest units of a batch or of a member, relative to the reference [scene units]."""

    now: Float[Tensor, "N 3"]
    before: Float[Tensor, "N 3"]
    # in the reference's axes: acceleration [scene units / frame^2], and the reference's displacement gradient by rows
    load: Float[Tensor, "N 12"] | None
    # nearness to the floor, and its normal in the reference's axes times the nearness; None: there is no floor
    floor: Float[Tensor, "N 4"] | None = None


class BodyMotion(ABC):
    """One step of a body whose reference moves."""

    relative: UnitMotion

    @abstractmethod
    def place(self, made: Placed) -> Placed:
        """The prediction relative to the reference, in the scene."""


class Carried:
    """A step relative to a reference at rest: positions are those in the scene."""

    def __init__(self, now: Float[Tensor, "N 3"], before: Float[Tensor, "N 3"]) -> None:
        self.relative = UnitMotion(now, before, None)

    def place(self, made: Placed) -> Placed:
        """The prediction in the scene."""
        return made


class Reference(ABC):
    """The reference of a batch."""

    @abstractmethod
    def carry(
        self,
        now: Float[Tensor, "N 3"],
        before: Float[Tensor, "N 3"],
        state: SimState,
        hands: Sequence[HandMotion | None] | None,
    ) -> Carried:
        """The finest units' positions relative to the reference, and the way back.

        ``now`` and ``before`` are in scene axes; ``hands`` are those of every member.
        """

    @abstractmethod
    def undeformed(self, state: SimState) -> tuple[Float[Tensor, "R 3 3"], Float[Tensor, "R 3 3"]]:
        """Deformation gradients and rotations of all rows of a step where the bodies have their rest shape."""

    def turned(self, state: SimState) -> Float[Tensor, "N 3 3"] | None:
        """Rotation of the undeformed body of every finest unit in a state of the kernels; None where nothing moves."""
        return None

    @abstractmethod
    def isolated(self, state: SimState, hands: Sequence[HandMotion | None] | None) -> SimState:
        """A state of the kernels relative to the reference."""


class StillReference(Reference):
    """The reference of a batch in which nothing moves as a whole."""

    def __init__(self, batch: SceneBatch) -> None:
        """Stores the number of rows."""
        self._rows, self._like = batch.members[-1].units.stop, batch.rest

    def carry(self, now: Tensor, before: Tensor, state: SimState, hands: Sequence[HandMotion | None] | None) -> Carried:
        """The units' positions as they are."""
        return Carried(now, before)

    def undeformed(self, state: SimState) -> tuple[Float[Tensor, "R 3 3"], Float[Tensor, "R 3 3"]]:
        """Identities."""
        identity = torch.eye(3).to(self._like).expand(self._rows, 3, 3)
        return identity, identity

    def isolated(self, state: SimState, hands: Sequence[HandMotion | None] | None) -> SimState:
        """The state as it is."""
        return state


class Body(ABC):
    """A member of a batch whose reference moves; constant between two updates of the parameters."""

    @abstractmethod
    def carry(self, now: Tensor, before: Tensor, state: SimState, hands: HandMotion | None) -> BodyMotion:
        """A step of the body from its units (N, 3) and kernels (K, 3) at t and t - 1, in scene axes."""

    @abstractmethod
    def isolated(self, state: SimState, hands: HandMotion | None) -> SimState:
        """A state of the body's kernels relative to the reference."""

    @abstractmethod
    def turned(self, state: SimState) -> Float[Tensor, "3 3"]:
        """Rotation of the undeformed body in a state of its kernels."""


class MovingReference(Reference):
    """The references of a batch, member by member."""

    def __init__(self, batch: SceneBatch, bodies: Sequence[Body | None]) -> None:
        """``bodies`` has one entry per member; None: its reference is at rest."""
        self._members, self._spans, self._bodies = batch.members, batch.levels[-1].spans, bodies

    def undeformed(self, state: SimState) -> tuple[Float[Tensor, "R 3 3"], Float[Tensor, "R 3 3"]]:
        """Rotations of the bodies; identities for kernels that never move."""
        turned, still = self.turned(state), torch.eye(3).to(state.positions)[None]
        whole = torch.cat([part for span in self._spans for part in (turned[span], still)])
        return whole, whole

    def turned(self, state: SimState) -> Float[Tensor, "N 3 3"]:
        """Rotation of the undeformed body of every finest unit in a state of the kernels."""
        parts = []
        for member, span, body in zip(self._members, self._spans, self._bodies, strict=True):
            rotation = torch.eye(3).to(state.positions)
            if body is not None:
                rotation = body.turned(SimState(state.positions[member.kernels], state.previous[member.kernels]))
            parts.append(rotation.expand(span.stop - span.start, 3, 3))
        return torch.cat(parts)

    def isolated(self, state: SimState, hands: Sequence[HandMotion | None] | None) -> SimState:
        """A state of the kernels relative to the references."""
        parts = []
        for i, (member, body) in enumerate(zip(self._members, self._bodies, strict=True)):
            own = SimState(state.positions[member.kernels], state.previous[member.kernels])
            parts.append(own if body is None else body.isolated(own, None if hands is None else hands[i]))
        return SimState(torch.cat([p.positions for p in parts]), torch.cat([p.previous for p in parts]))

    def carry(self, now: Tensor, before: Tensor, state: SimState, hands: Sequence[HandMotion | None] | None) -> Carried:
        """The finest units' positions relative to the references, and the way back."""
        motions: list[BodyMotion | None] = []
        parts: list[UnitMotion] = []
        for i, (member, span, body) in enumerate(zip(self._members, self._spans, self._bodies, strict=True)):
            if body is None:
                motions.append(None)
                parts.append(UnitMotion(now[span], before[span], now.new_zeros(len(now[span]), 12)))
                continue
            own = SimState(state.positions[member.kernels], state.previous[member.kernels])
            motions.append(body.carry(now[span], before[span], own, None if hands is None else hands[i]))
            parts.append(motions[-1].relative)  # type: ignore[union-attr]
        return _CarriedBodies(self._members, motions, parts, state)


class _CarriedBodies(Carried):
    def __init__(
        self,
        members: Sequence[Member],
        motions: Sequence[BodyMotion | None],
        parts: Sequence[UnitMotion],
        state: SimState,
    ) -> None:
        self._members, self._motions, self._state = members, motions, state
        load = torch.cat([part.load for part in parts if part.load is not None])
        floor = None
        if any(part.floor is not None for part in parts):
            floor = torch.cat([p.now.new_zeros(len(p.now), 4) if p.floor is None else p.floor for p in parts])
        now, before = torch.cat([p.now for p in parts]), torch.cat([p.before for p in parts])
        self.relative = UnitMotion(now, before, load, floor)

    def place(self, made: Placed) -> Placed:
        placed = []
        for member, motion in zip(self._members, self._motions, strict=True):
            rows = made.deformation_gradients[member.units], made.rotations[member.units]
            own = Placed(made.positions[member.kernels], *rows)
            placed.append(own if motion is None else motion.place(own))
        positions = torch.cat([own.positions for own in placed])
        deformation = torch.cat([own.deformation_gradients for own in placed])
        rotations = torch.cat([own.rotations for own in placed])
        previous = None
        if any(own.previous is not None for own in placed):
            now = [self._state.positions[member.kernels] for member in self._members]
            before = [own.previous for own in placed]
            previous = torch.cat([a if b is None else b for a, b in zip(now, before, strict=True)])
        return Placed(positions, deformation, rotations, previous)
