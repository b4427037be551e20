"""Forces as words on the command line: `--force on=tip weights=3 direction=x frames=12`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from gausim.core.errors import ConfigError

if TYPE_CHECKING:
    from gausim.core import GaussianScene
    from gausim.interaction.selections import Selected
    from gausim.interaction.session import Entry

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
# Radius of the ball about the tip [diagonals].
_TIP = 0.15
# What each kind of event needs to be told, and what it may be told besides.
_WORDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "force": (("weights", "direction"), ("on", "at", "frames")),
    "impulse": (("weight_seconds", "direction"), ("on", "at")),
    "wind": (("weights", "direction"), ("gusts", "at")),
    "gravity": (("weights", "direction"), ("at",)),
    "pin": (("on",), ("at",)),
    "unpin": ((), ("on", "at")),
}
_HELP = {
    "force": "on=PART weights=W direction=D [at=FRAME] [frames=N]: W times the part's weight, from FRAME, for N frames",
    "impulse": "on=PART weight_seconds=J direction=D [at=FRAME]: the speed that weight gives in J seconds, at once",
    "wind": "weights=W direction=D [gusts=0..1] [at=FRAME]: on all kernels by their cross-section, until the next",
    "gravity": "weights=W direction=D [at=FRAME]: besides that of the recording, until the next",
    "pin": "on=PART [at=FRAME]: hold it where it is",
    "unpin": "[on=PART] [at=FRAME]: let it go",
}
EPILOG = """\
parts of an object (on=PART):
  whole                 all of it (the default)
  tip[:RADIUS]          a ball about the kernel farthest from the pinned ones; RADIUS in diagonals (default 0.15)
  unit:LEVEL/INDEX      a unit of the hierarchy, e.g. unit:1/7 (`gausim inspect SCENE` draws them)
  ball:X,Y,Z,RADIUS     kernels at rest within RADIUS diagonals of a point
  kernels:0-9,12        listed kernels
directions (direction=D): x, -x, y, -y, z, -z or X,Y,Z
example:
  gausim simulate RUN --force on=tip weights=3 direction=x at=5 frames=8 --wind weights=0.2 direction=y gusts=0.5
"""


def add_force_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options for forces and sessions."""
    group = parser.add_argument_group("forces", "Forces in multiples of the weight of what they act on; each may be "
                                      "given several times. With any, the object starts at rest, or as the one "
                                      "--sequence does.")  # fmt: skip
    for kind, text in _HELP.items():
        group.add_argument(f"--{kind}", nargs="+", action="append", default=[], metavar="KEY=VALUE", help=text)
    group.add_argument("--session", metavar="FILE", help="replay a session that was recorded (gausim view, --force)")
    group.add_argument("--metre", type=float, default=1.0, metavar="UNITS",
                       help="scene units in a metre, which say what a weight is (default: 1)")  # fmt: skip
    group.add_argument("--most-force", type=float, metavar="WEIGHTS", help="the largest force (default: 10)")


def has_forces(arguments: argparse.Namespace) -> bool:
    """Whether any was given."""
    return any(getattr(arguments, kind) for kind in _WORDS)


def entries_of(arguments: argparse.Namespace, scene: GaussianScene) -> list[Entry]:
    """The events of the command line in the order of their time.

    Raises:
        ConfigError: a word is unknown, missing or wrong; names the option.
    """
    entries = [entry_of(kind, words, scene) for kind in _WORDS for words in getattr(arguments, kind)]
    entries = [_named(entry, number) for number, entry in enumerate(entries)]
    return sorted(entries, key=lambda entry: entry.at)


def entry_of(kind: str, words: Sequence[str], scene: GaussianScene) -> Entry:
    """One event of the command line.

    Raises:
        ConfigError: a word is unknown, missing or wrong; names the option.
    """
    from gausim.interaction.session import KINDS, Entry

    needed, allowed = _WORDS[kind]
    try:
        values = _values(words, (*needed, *allowed))
        missing = [name for name in needed if name not in values]
        if missing:
            raise ConfigError(f"'{missing[0]}=' is missing. Expected {_HELP[kind]}.")
        at = _whole(values.pop("at", "0"))
        read: dict[str, Callable[[str], Any]] = {
            "on": lambda text: parse_part(text, scene), "direction": parse_direction, "frames": _whole,
        }  # fmt: skip
        made = {name: read.get(name, _number)(text) for name, text in values.items()}
        if kind in ("force", "impulse"):
            made.setdefault("on", parse_part("whole", scene))
        return Entry(at, KINDS[kind](**made))
    except ConfigError as error:
        raise ConfigError(f"--{kind} {' '.join(words)}: {error}") from error


def parse_part(text: str, scene: GaussianScene) -> Selected:
    """Reads a part of an object, see :data:`EPILOG`.

    Raises:
        ConfigError: it is of another form.
    """
    from gausim.interaction.selections import Ball, Unit, Whole, parse_kernels

    kind, _, rest = text.partition(":")
    if kind == "whole" and not rest:
        return Whole()
    if kind == "tip":
        return _tip(scene, _number(rest) if rest else _TIP)
    if kind == "unit" and rest.count("/") == 1:
        level, _, index = rest.partition("/")
        return Unit(_whole(level), _whole(index))
    if kind == "kernels":
        return parse_kernels(rest)
    if kind == "ball" and rest.count(",") == 3:
        x, y, z, radius = map(_number, rest.split(","))
        return Ball((x, y, z), radius)
    raise ConfigError(
        f"on={text}: expected whole, tip, tip:RADIUS, unit:LEVEL/INDEX, ball:X,Y,Z,RADIUS or kernels:0-9,12."
    )


def parse_direction(text: str) -> tuple[float, float, float]:
    """Reads ``x``, ``-z`` or ``X,Y,Z``.

    Raises:
        ConfigError: it is of another form.
    """
    sign, name = (-1.0, text[1:]) if text.startswith("-") else (1.0, text)
    if name in _AXES:
        x, y, z = _AXES[name]
        return sign * x, sign * y, sign * z
    parts = text.split(",")
    if len(parts) != 3:
        raise ConfigError(f"direction={text}: expected x, -x, y, -y, z, -z or X,Y,Z.")
    x, y, z = map(_number, parts)
    return x, y, z


def _tip(scene: GaussianScene, radius: float) -> Selected:
    from gausim.interaction.selections import Ball

    free = scene.means[scene.simulated & ~scene.pinned]
    root = scene.means[scene.pinned].mean(0)
    x, y, z = free[(free - root).norm(dim=-1).argmax()].tolist()
    return Ball((x, y, z), radius)


def _values(words: Sequence[str], known: Sequence[str]) -> dict[str, str]:
    values: dict[str, str] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or name not in known or name in values:
            raise ConfigError(f"'{word}': expected KEY=VALUE, each once, with a key of {', '.join(known)}.")
        values[name] = text
    return values


def _number(text: str) -> float:
    from gausim.interaction.selections import number

    try:
        return number("number", float(text))
    except ValueError:
        raise ConfigError(f"'{text}': expected a number.") from None


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ConfigError(f"'{text}': expected a whole number.") from None


def _named(entry: Entry, number: int) -> Entry:
    """Forces of the command line last beside each other, so each has a name of its own."""
    from dataclasses import replace

    from gausim.interaction.session import Force

    return replace(entry, event=replace(entry.event, name=f"force {number}")) if isinstance(
        entry.event, Force
    ) else entry  # fmt: skip
