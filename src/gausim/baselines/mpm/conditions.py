"""Boundary conditions and pushes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gausim.baselines.mpm.mapping import SceneMapping, Vector
from gausim.baselines.mpm.particles import ParticleState
from gausim.core import ConfigError


@dataclass(frozen=True)
class Box:
    """An axis-aligned box.

    Attributes:
        lower: least corner.
        upper: greatest corner.
    """

    lower: Vector
    upper: Vector

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise ConfigError(f"box: expected lower < upper in every coordinate, got {self.lower} and {self.upper}.")

    def contains(self, points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """Which points lie in the box."""
        return ((points >= points.new_tensor(self.lower)) & (points <= points.new_tensor(self.upper))).all(-1)

    def mapped(self, mapping: SceneMapping) -> Box:
        """The box of the scene in the simulation."""
        return Box(
            mapping.vector_to_simulation(self.lower, point=True), mapping.vector_to_simulation(self.upper, point=True)
        )


@dataclass(frozen=True)
class PrescribedMotion:
    """Nodes in a box have a given velocity for some time; with velocity 0 it is a pinned box.

    Attributes:
        box: the box at the start.
        velocity: velocity of its nodes [length / s].
        start: when it begins [s].
        end: when it ends [s].
        follows: whether the box moves along with its velocity.
    """

    box: Box
    velocity: Vector = (0.0, 0.0, 0.0)
    start: float = 0.0
    end: float = math.inf
    follows: bool = False

    def mapped(self, mapping: SceneMapping) -> PrescribedMotion:
        """The same in the simulation's coordinates."""
        return replace(self, box=self.box.mapped(mapping), velocity=mapping.vector_to_simulation(self.velocity))


def pinned_box(box: Box) -> PrescribedMotion:
    """Nodes in the box do not move, ever."""
    return PrescribedMotion(box)


@dataclass(frozen=True)
class Impulse:
    """Particles in a box change their velocity at once, when a frame begins.

    Attributes:
        box: the particles, or none for all.
        velocity: change of velocity, that is impulse per mass [length / s].
        frame: number of the frame at whose beginning it acts; 0 makes it an initial velocity.
    """

    box: Box | None
    velocity: Vector
    frame: int = 0

    def mapped(self, mapping: SceneMapping) -> Impulse:
        """The same in the simulation's coordinates."""
        box = self.box.mapped(mapping) if self.box else None
        return replace(self, box=box, velocity=mapping.vector_to_simulation(self.velocity))

    def applied(self, state: ParticleState) -> ParticleState:
        """The state after the impulse."""
        change = state.velocities.new_tensor(self.velocity).expand_as(state.velocities)
        if self.box is not None:
            change = change * self.box.contains(state.positions.detach())[:, None]
        return replace(state, velocities=state.velocities + change)


@dataclass(frozen=True)
class Conditions:
    """All of them.

    Attributes:
        motions: prescribed motions and pinned boxes; where two overlap the later one wins.
        impulses: changes of velocity.
    """

    motions: tuple[PrescribedMotion, ...] = ()
    impulses: tuple[Impulse, ...] = ()

    def mapped(self, mapping: SceneMapping) -> Conditions:
        """The conditions of a scene in the simulation's coordinates."""
        return Conditions(
            tuple(m.mapped(mapping) for m in self.motions), tuple(i.mapped(mapping) for i in self.impulses)
        )

    def pushed(self, state: ParticleState, frame: int) -> ParticleState:
        """The state with the impulses of this frame."""
        for impulse in self.impulses:
            if impulse.frame == frame:
                state = impulse.applied(state)
        return state

    def packed(self, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(lower, upper, velocity, (start, end, follows)) of the prescribed motions, one row each."""
        rows = [(m.box.lower, m.box.upper, m.velocity, (m.start, m.end, float(m.follows))) for m in self.motions]
        columns = zip(*rows, strict=True) if rows else ((), (), (), ())
        lower, upper, velocity, span = (
            torch.tensor(c, dtype=torch.float32, device=device).reshape(-1, 3) for c in columns
        )
        return lower, upper, velocity, span
