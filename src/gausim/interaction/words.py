"""Command-line syntax of forces: `--force on=tip weights=3 direction=x frames=12`."""

import argparse
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from gausim.core.errors import ConfigError

if TYPE_CHECKING:
    from gausim.core import GaussianScene
    from gausim.interaction.selections import Selected
    from gausim.interaction.session import Entry

# Radius of the ball about the tip [diagonals].
_TIP = 0.15
_HELP = {
    "force": "on=PART weights=W direction=D [at=FRAME] [frames=N]: W times the part's weight, from FRAME, for N frames",
    "impulse": "on=PART weight_seconds=J direction=D [at=FRAME]: the speed that weight gives in J seconds, at once",
    "wind": "weights=W direction=D [gusts=0..1] [at=FRAME]: on all kernels by their cross-section, until the next",
    "gravity": "weights=W direction=D [at=FRAME]: besides that of the recording, until the next",
    "pin": "on=PART [at=FRAME]: hold it where it is",
    "unpin": "[on=PART] [at=FRAME]: let it go",
    "hand": "to=X,Y,Z [frames=N] [turn=X,Y,Z] [hand=H] [at=FRAME]: move the pins to a place relative to rest [scene "
    "units], turned by an axis times an angle [radian], within N frames",
    "material": "[stiffness=S] [damping=D] [at=FRAME]: multiply those at the beginning, of a scene moved --from a base",
}
EPILOG = """\
parts of an object (on=PART):
  whole                 all of it (the default)
  tip[:RADIUS]          a ball about the kernel farthest from the pins (or the middle); RADIUS in diagonals (0.15)
  unit:LEVEL/INDEX      a unit of the hierarchy, e.g. unit:1/7 (`gausim inspect SCENE` draws them)
  ball:X,Y,Z,RADIUS     kernels at rest within RADIUS diagonals of a point
  kernels:0-9,12        listed kernels
directions (direction=D): x, -x, y, -y, z, -z or X,Y,Z
example:
  gausim simulate RUN --force on=tip weights=3 direction=x at=5 frames=8 --wind weights=0.2 direction=y gusts=0.5
"""


def add_force_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options for forces and sessions."""
    group = parser.add_argument_group("forces", "Forces in multiples of the weight of their part; each may be given "
                                      "several times. With any, the object starts at rest, or as the one "
                                      "--sequences does.")  # fmt: skip
    for kind, text in _HELP.items():
        group.add_argument(f"--{kind}", nargs="+", action="append", default=[], metavar="KEY=VALUE", help=text)
    group.add_argument("--session", metavar="FILE", help="replay a session that was recorded (gausim view, --force)")
    group.add_argument("--metre", type=float, default=1.0, metavar="UNITS",
                       help="scale the unit of weight by so many scene units per metre (default: 1)")  # fmt: skip
    group.add_argument("--most-force", type=float, metavar="WEIGHTS",
                       help="limit forces to so many weights (default: 10)")  # fmt: skip


def has_forces(arguments: argparse.Namespace) -> bool:
    """Whether any option for forces was given."""
    return any(getattr(arguments, kind) for kind in _HELP)


def entries_of(arguments: argparse.Namespace, scene: "GaussianScene") -> "list[Entry]":
    """The events of the command line, sorted by time; distinct names let all forces act at the same time.

    Raises:
        ConfigError: a key is unknown or missing, or a value is invalid; the message names the option.
    """
    given = [(kind, words) for kind in _HELP for words in getattr(arguments, kind)]
    entries = [entry_of(kind, words, scene, name=f"force {number}") for number, (kind, words) in enumerate(given)]
    return sorted(entries, key=lambda entry: entry.at)


def entry_of(kind: str, words: Sequence[str], scene: "GaussianScene", *, name: str = "force") -> "Entry":
    """One event of the command line; ``name`` is used for forces.

    Raises:
        ConfigError: a key is unknown or missing, or a value is invalid; the message names the option.
    """
    from msgspec.structs import fields

    from gausim.interaction.checked import made
    from gausim.interaction.selections import Whole
    from gausim.interaction.session import KINDS, Entry

    read: dict[str, Callable[[str], Any]] = {
        "on": lambda text: parse_part(text, scene), "direction": parse_direction, "frames": _whole, "at": _whole,
        "to": parse_direction, "turn": parse_direction, "hand": _whole,
    }  # fmt: skip
    values: dict[str, Any] = {"on": Whole()} if kind in ("force", "impulse") else {}
    values |= {"name": name} if kind == "force" else {}
    known = {"at", *(field.name for field in fields(KINDS[kind]) if field.name != "name")}
    texts: dict[str, str] = {}
    try:
        for word in words:
            key, equals, text = word.partition("=")
            if not equals or key not in known or key in texts:
                raise ConfigError(f"'{word}': expected KEY=VALUE, each once, with a key of {', '.join(sorted(known))}.")
            texts[key] = text
        values |= {key: read.get(key, _number)(text) for key, text in texts.items()}
        return Entry(values.pop("at", 0), made(KINDS[kind], values))
    except ConfigError as error:
        raise ConfigError(f"--{kind} {' '.join(words)}: {error} Expected {_HELP[kind]}.") from error


def parse_part(text: str, scene: "GaussianScene") -> "Selected":
    """Parses a part of an object, see :data:`EPILOG`.

    Raises:
        ConfigError: the text has another form.
    """
    from gausim.interaction.selections import Ball, Unit, Whole, parse_kernels

    kind, _, rest = text.partition(":")
    if kind == "whole" and not rest:
        return Whole()
    if kind == "tip":
        free = scene.means[scene.simulated & ~scene.pinned]
        root = (scene.means[scene.pinned] if bool(scene.pinned.any()) else free).mean(0)
        x, y, z = free[(free - root).norm(dim=-1).argmax()].tolist()
        return Ball((x, y, z), _number(rest) if rest else _TIP)
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
    """Parses a direction: ``x``, ``+x``, ``-z`` or ``X,Y,Z``.

    Raises:
        ConfigError: the text has another form.
    """
    if (name := text[-1:]) in "xyz" and text in (name, f"+{name}", f"-{name}"):
        x, y, z = ((-1.0 if text[0] == "-" else 1.0) * (name == axis) for axis in "xyz")
    elif text.count(",") == 2:
        x, y, z = map(_number, text.split(","))
    else:
        raise ConfigError(f"direction={text}: expected x, -x, y, -y, z, -z or X,Y,Z.")
    return x, y, z


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"'{text}': expected a number.") from None


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ConfigError(f"'{text}': expected a whole number.") from None
