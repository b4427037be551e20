"""Common arguments of several commands."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gausim.cli.main import COMMANDS
from gausim.core.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

    from gausim.core.scene import GaussianScene
    from gausim.interaction.interaction import Interaction


# Vertical axes of scenes; a minus where the axis points down.
UPS = ("x", "y", "z", "-x", "-y", "-z")


def command_parser(name: str, more: str = "", epilog: str = "") -> argparse.ArgumentParser:
    """The parser of a command, described by its line of `gausim --help` and ``more``; line breaks are kept."""
    raw: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter} if "\n" in more + epilog else {}
    return argparse.ArgumentParser(prog=f"gausim {name}", description=COMMANDS[name] + more, epilog=epilog, **raw)


def add_data_option(parser: argparse.ArgumentParser) -> None:
    """Adds ``--data``, which :func:`gausim.compose.data_paths.data_option` reads."""
    parser.add_argument(
        "--data", action="append", default=[], metavar="DIR|scene=FILE",
        help="where the run's data set lies now, and scene=FILE or masks=FILE where its configuration names such; of "
        "several sets give each, in the configuration's order (default: where it was trained)",
    )  # fmt: skip


def add_pin_options(parser: argparse.ArgumentParser) -> None:
    """Adds --pin-below and --pin-above, which mark roots by height."""
    add = parser.add_argument
    add("--pin-below", metavar="AXIS=VALUE", help="pin kernels whose coordinate is below, e.g. z=0.33")
    add("--pin-above", metavar="AXIS=VALUE", help="pin kernels whose coordinate is above (scenes with up = -y)")


def pinned_by(scene: GaussianScene, arguments: argparse.Namespace, *, below_z: float | None = None) -> GaussianScene:
    """The scene with its pins replaced by the union of --pin-below and --pin-above, else by those below a height."""
    from gausim.ops.selection import apply_masks, parse_half_space

    below, above = arguments.pin_below, arguments.pin_above
    if below_z is not None and not (below or above):
        below = f"z={below_z}"
    sides = ((below, False), (above, True))
    chosen = [parse_half_space(text, above=above) for text, above in sides if text]
    return apply_masks(scene, pinned=chosen[0] | chosen[-1]) if chosen else scene


def add_scene_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Adds the options of a scene without videos, which :func:`opened_scene` reads; returns their group."""
    group = parser.add_argument_group("a scene without a run")
    add = group.add_argument
    add("--from", dest="base", metavar="RUN", type=Path, help="run of model=gausim whose network moves the scene")
    add("--stiffness", type=float, metavar="S",
        help="the slowest swing takes S^(-1/2) seconds (default with --from: 1)")  # fmt: skip
    add("--damping", type=float, metavar="D",
        help="amplitudes fall as exp(-D t / 2) [1 / s] (default with --from: 0.5)")  # fmt: skip
    add("--fps", type=float, default=30.0, help="frames per second (default: 30)")
    add("--seed", type=int, default=0, help="of the random weights of an untrained model (default: 0)")
    add_pin_options(parser)
    return group


def opened_scene(scene: GaussianScene, arguments: argparse.Namespace, **options: Any) -> Interaction:
    """The scene with the model of :func:`add_scene_options`; ``options`` are those of `open_scene`.

    Raises:
        ConfigError: a number is not positive.
    """
    from gausim.compose.bare import EvenMaterial, open_scene

    given = {"stiffness": arguments.stiffness, "damping": arguments.damping}
    material = {name: value for name, value in given.items() if value is not None}
    even = EvenMaterial(**material) if material else None
    return open_scene(scene, fps=arguments.fps, base=arguments.base, seed=arguments.seed, material=even, **options)


def positive(text: str) -> int:
    """Reads a whole number above 0."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text}")
    return value


def parse_background(text: str) -> Tensor | None:
    """Reads a background colour; None is black.

    Raises:
        ConfigError: the text is neither a name nor three numbers in 0..1.
    """
    import torch

    if text == "black":
        return None
    try:
        color = [1.0, 1.0, 1.0] if text == "white" else [float(v) for v in text.split(",")]
    except ValueError:
        color = []
    if len(color) != 3 or not all(0 <= v <= 1 for v in color):
        raise ConfigError(
            f"--background {text}: expected black, white or R,G,B with numbers in 0..1, e.g. 0.2,0.2,0.2."
        )
    return torch.tensor(color)
