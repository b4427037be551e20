"""The reference configuration of a body that moves as a whole or in hands, and the step relative to it.

Everything that the simulator learns happens relative to a reference configuration. For a body in fixed pins it is
the rest state. For one that moves it is carried along (the floating frame of reference of multibody dynamics, Shabana
2020): unit n has the reference position a_n, rotation B_n and deformation gradient A_n, and the simulator sees

    y_n = X_n + B_n^T (x_n - a_n)

at t - 1 and t, and a load: the inertial acceleration of the reference, gravity, and the strain of the reference. Its
prediction y, G, Q of the kernels at t + 1 goes back to

    x_k = a_c + A_c (X_k - X_c) + B_c (y_k - X_k),   A_c + B_c (G_c - I),   B_c Q_c.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Frame, HandPose, Hands, SimState
from gausim.models.hierarchy.batch import Member, SceneBatch
from gausim.models.hierarchy.units import UnitMotion


class HandMotion(NamedTuple):
    """Poses of a body's hands in the three frames of a step; None where they are at rest."""

    before: HandPose | None
    now: HandPose | None
    after: HandPose | None


def hand_motion(hands: Hands | None, frame: int) -> HandMotion | None:
    """Poses of the step from ``frame`` to the next; None without hands."""
    return None if hands is None else HandMotion(hands(frame - 1), hands(frame), hands(frame + 1))


def turned_units(rotation: Float[Tensor, "3 3"], matrices: Float[Tensor, "R 3 3"]) -> Float[Tensor, "R 3 3"]:
    """Matrices of the units after a rotation of the body; the identity row, the last, stays."""
    return torch.cat((rotation @ matrices[:-1], matrices[-1:]))


class Carried:
    """A step relative to a reference; in this base class to one at rest, where positions are those in the scene."""

    def __init__(self, relative: UnitMotion) -> None:
        self.relative = relative

    def place(self, frame: Frame) -> Frame:
        """The prediction relative to the reference, in the scene."""
        return frame


class Body:
    """A member of a batch, constant between two updates of the parameters; in this base class its reference is at rest.

    States are those of its kernels (K, 3), in scene axes; ``rest`` are its units' centres of mass at rest (N, 3).
    """

    def __init__(self, rest: Float[Tensor, "N 3"]) -> None:
        self.units = rest

    def carry(self, now: Tensor, before: Tensor, state: SimState, hands: HandMotion | None) -> Carried:
        """A step of the body from its units (N, 3) and kernels at t and t - 1."""
        return Carried(UnitMotion(self.units, now, before, now.new_zeros(len(now), 12)))

    def turned(self, state: SimState) -> Float[Tensor, "3 3"]:
        """Rotation of the undeformed body in a state."""
        return torch.eye(3).to(state.positions)


class Reference:
    """The reference of a batch; in this base class nothing moves as a whole."""

    moves = False

    def __init__(self, batch: SceneBatch, rest: Float[Tensor, "N 3"]) -> None:
        """``rest`` are the centres of mass of the finest units."""
        self._members, self._spans, self._like, self.rest = batch.members, batch.levels[-1].spans, batch.rest, rest

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
        return Carried(UnitMotion(self.rest, now, before))

    def undeformed(self, state: SimState) -> tuple[Float[Tensor, "R 3 3"], Float[Tensor, "R 3 3"]]:
        """Deformation gradients and rotations of all rows of a step where the bodies have their rest shape."""
        identity = torch.eye(3).to(self._like).expand(self._members[-1].units.stop, 3, 3)
        return identity, identity

    def turned(self, state: SimState) -> Float[Tensor, "N 3 3"] | None:
        """Rotation of the undeformed body of every finest unit in a state of the kernels; None where nothing moves."""
        return None


class MovingReference(Reference):
    """The references of a batch, member by member."""

    moves = True

    def __init__(self, batch: SceneBatch, rest: Float[Tensor, "N 3"], bodies: Sequence[Body]) -> None:
        """``bodies`` has one entry per member."""
        super().__init__(batch, rest)
        self._bodies = bodies

    def _own(self, state: SimState) -> Iterator[SimState]:
        """The states of the members' kernels, in turn."""
        for member in self._members:
            yield SimState(state.positions[member.kernels], state.previous[member.kernels])

    def undeformed(self, state: SimState) -> tuple[Float[Tensor, "R 3 3"], Float[Tensor, "R 3 3"]]:
        """Rotations of the bodies; identities for kernels that never move."""
        turned, still = self.turned(state), torch.eye(3).to(state.positions)[None]
        whole = torch.cat([part for span in self._spans for part in (turned[span], still)])
        return whole, whole

    def turned(self, state: SimState) -> Float[Tensor, "N 3 3"]:
        """Rotation of the undeformed body of every finest unit in a state of the kernels."""
        members = zip(self._bodies, self._own(state), self._spans, strict=True)
        return torch.cat([body.turned(own).expand(span.stop - span.start, 3, 3) for body, own, span in members])

    def carry(self, now: Tensor, before: Tensor, state: SimState, hands: Sequence[HandMotion | None] | None) -> Carried:
        """The finest units' positions relative to the references, and the way back."""
        hands = hands or [None] * len(self._bodies)
        members = zip(self._bodies, self._spans, self._own(state), hands, strict=True)
        motions = [body.carry(now[span], before[span], own, held) for body, span, own, held in members]
        return _CarriedBodies(self._members, self.rest, motions, state)


class _CarriedBodies(Carried):
    def __init__(self, members: Sequence[Member], rest: Tensor, motions: Sequence[Carried], state: SimState) -> None:
        self._members, self._motions, self._state = members, motions, state
        parts = [motion.relative for motion in motions]
        load = torch.cat([part.load for part in parts if part.load is not None])
        floor = None
        if any(part.floor is not None for part in parts):
            floor = torch.cat([p.now.new_zeros(len(p.now), 4) if p.floor is None else p.floor for p in parts])
        now, before = torch.cat([p.now for p in parts]), torch.cat([p.before for p in parts])
        super().__init__(UnitMotion(rest, now, before, load, floor))

    def place(self, frame: Frame) -> Frame:
        parts = []
        for member, motion in zip(self._members, self._motions, strict=True):
            rows = frame.deformation_gradients[member.units], frame.rotations[member.units]
            parts.append(motion.place(Frame(frame.positions[member.kernels], *rows)))
        positions, deformation, rotations = (
            torch.cat([getattr(part, name) for part in parts])
            for name in ("positions", "deformation_gradients", "rotations")
        )
        state = None
        if any(part.state is not None for part in parts):
            now = [self._state.positions[member.kernels] for member in self._members]
            before = [a if part.state is None else part.state.previous for a, part in zip(now, parts, strict=True)]
            state = SimState(positions, torch.cat(before))
        return replace(frame, positions=positions, deformation_gradients=deformation, rotations=rotations, state=state)
