"""What can be done to an object: the events of a session."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from gausim.core import ConfigError
from gausim.interaction.selections import Selected, Whole

MOST_STEPS = 100_000
# Characters of a name, of anything.
MOST_NAME = 200


@dataclass(frozen=True)
class Force:
    """A force that lasts until it is released, or some frames; one of the same name takes the place of the last.

    Attributes:
        on: what it acts on; pinned kernels of it feel nothing.
        direction: of any length but zero.
        weights: its size [weights of the free kernels that it acts on].
        frames: how long it lasts; None: until it is released.
        name: by which it is released.
    """

    on: Selected
    direction: tuple[float, float, float]
    weights: float
    frames: int | None = None
    name: str = "force"

    def __post_init__(self) -> None:
        _direction(self)
        _amount("weights", self.weights)
        _name(self.name)
        if self.frames is not None and not 1 <= self.frames <= MOST_STEPS:
            raise ConfigError(f"field 'frames': expected null or 1 to {MOST_STEPS}, got {self.frames!r}.")


@dataclass(frozen=True)
class Release:
    """Ends the force of a name, or all forces.

    Attributes:
        name: of the force; None: all of them.
    """

    name: str | None = None

    def __post_init__(self) -> None:
        _name(self.name)


@dataclass(frozen=True)
class Impulse:
    """A push within one frame.

    Attributes:
        on: what it acts on.
        direction: of any length but zero.
        weight_seconds: its size; 1 gives the speed that weight gives in a second.
    """

    on: Selected
    direction: tuple[float, float, float]
    weight_seconds: float

    def __post_init__(self) -> None:
        _direction(self)
        _amount("weight_seconds", self.weight_seconds)


@dataclass(frozen=True)
class Gravity:
    """Gravity besides that in which the object was recorded, until the next one.

    Attributes:
        direction: of any length but zero.
        weights: its size [weights of the object]; 0 for none.
    """

    direction: tuple[float, float, float]
    weights: float

    def __post_init__(self) -> None:
        _direction(self)
        _amount("weights", self.weights)


@dataclass(frozen=True)
class Wind:
    """A wind, until the next one: a force on every kernel that goes with its cross-section.

    Attributes:
        direction: in which it blows; of any length but zero.
        weights: its force on the whole object, in the mean over time [weights of the object]; 0 for none.
        gusts: how much it rises and falls, in 0..1.
    """

    direction: tuple[float, float, float]
    weights: float
    gusts: float = 0.0

    def __post_init__(self) -> None:
        _direction(self)
        _amount("weights", self.weights)
        if not 0 <= self.gusts <= 1:
            raise ConfigError(f"field 'gusts': expected a number in 0..1, got {self.gusts!r}.")


@dataclass(frozen=True)
class Pin:
    """Holds kernels where they are.

    Attributes:
        on: what is held.
    """

    on: Selected


@dataclass(frozen=True)
class Unpin:
    """Lets go of kernels that were pinned by hand; those that the scene pins stay so.

    Attributes:
        on: what is let go.
    """

    on: Selected = field(default_factory=Whole)


@dataclass(frozen=True)
class Reset:
    """Back to the initial state, with no force, wind, gravity or pin."""


Event = Force | Release | Impulse | Gravity | Wind | Pin | Unpin | Reset
KINDS: dict[str, type] = {t.__name__.lower(): t for t in (Force, Release, Impulse, Gravity, Wind, Pin, Unpin, Reset)}


def _direction(event: Force | Impulse | Gravity | Wind) -> None:
    if not 1e-12 < math.hypot(*event.direction) < 1e12:
        raise ConfigError(f"field 'direction': expected a vector that is not zero, got {event.direction}.")


def _amount(name: str, value: float) -> None:
    if not 0 <= value < 1e9:
        raise ConfigError(f"field '{name}': expected a number >= 0, got {value!r}.")


def _name(value: str | None) -> None:
    if value is not None and not 0 < len(value) <= MOST_NAME:
        raise ConfigError(f"field 'name': expected a text of 1 to {MOST_NAME} characters, got {value[:80]!r}.")
