"""Options that several commands share, each with one spelling and one meaning."""

import argparse
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Any

from gausim.cli.main import COMMANDS
from gausim.core.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

    from gausim.core.scene import GaussianScene


# Vertical axes of scenes; a minus where the axis points down.
UPS = ("x", "y", "z", "-x", "-y", "-z")


def command_parser(name: str, more: str = "", epilog: str = "") -> argparse.ArgumentParser:
    """The parser of a command, described by its line of `gausim --help` and ``more``; line breaks are kept."""
    raw: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter} if "\n" in more + epilog else {}
    return argparse.ArgumentParser(prog=f"gausim {name}", description=COMMANDS[name] + more, epilog=epilog, **raw)


def add_names(parser: argparse._ActionsContainer, what: str, text: str, *, several: bool = True) -> None:
    """Adds ``--objects``, ``--sequences`` or ``--cameras``, which take names, or with ``several=False`` one name."""
    parser.add_argument(f"--{what}", nargs="+" if several else None, metavar="NAME", help=text)


def add_data_option(parser: argparse.ArgumentParser) -> None:
    """Adds ``--data``, which :func:`gausim.compose.data_paths.data_option` reads."""
    parser.add_argument(
        "--data", action="append", default=[], metavar="DIR|scene=FILE",
        help="read the run's data set from here, and a scene or masks from scene=FILE and masks=FILE; of several sets "
        "give each, in the configuration's order (default: where it was trained)",
    )  # fmt: skip


def add_threads_option(parser: argparse._ActionsContainer) -> None:
    """Adds ``--threads``."""
    parser.add_argument("--threads", type=positive, default=1, metavar="N", help="use N processor threads (default: 1)")


def add_device_options(parser: argparse._ActionsContainer) -> None:
    """Adds ``--device``, which :func:`gausim.compose.build.load_run` takes, and ``--threads``."""
    parser.add_argument(
        "--device", default="auto", metavar="auto|cpu|cuda[:N]",
        help="compute there (default: auto, the GPU where there is one)",
    )  # fmt: skip
    add_threads_option(parser)


def computing(arguments: argparse.Namespace) -> None:
    """Takes the threads of :func:`add_device_options` and refuses a device that is not there, before anything is read.

    Raises:
        ConfigError: there is no such device.
    """
    from torch import set_num_threads

    from gausim.compose.device import find_device

    set_num_threads(arguments.threads)
    find_device(arguments.device)


def add_pin_option(parser: argparse._ActionsContainer) -> None:
    """Adds ``--pin``, which :func:`pinned_by` reads."""
    parser.add_argument(
        "--pin", action="append", default=[], metavar="SIDE",
        help="pin the kernels of the scene on this side, e.g. \"below z=0.33\" or \"above y=1\" [scene units]; more "
        "than once: on any of the sides (default: the pins that are stored with the scene)",
    )  # fmt: skip


def pinned_by(scene: "GaussianScene", sides: list[str], *, below_z: float | None = None) -> "GaussianScene":
    """The scene with its pins replaced by the union of the sides of ``--pin``, else by those below a height."""
    from gausim.ops.selection import Selection, apply_masks, parse_half_space

    if not sides:
        sides = [] if below_z is None else [f"below z={below_z}"]
    chosen: list[Selection] = [parse_half_space(side) for side in sides]
    return apply_masks(scene, pinned=reduce(or_, chosen)) if chosen else scene


def positive(text: str) -> int:
    """Reads a whole number above 0."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text}")
    return value


def parse_background(text: str) -> "Tensor | None":
    """Reads a background colour; None is black.

    Raises:
        ConfigError: the text is neither a name nor three numbers in 0..1.
    """
    import torch

    named = {"black": None, "white": torch.ones(3)}
    if text in named:
        return named[text]
    try:
        color = [float(v) for v in text.split(",")]
    except ValueError:
        color = []
    if len(color) != 3 or not all(0 <= v <= 1 for v in color):
        raise ConfigError(
            f"--background {text}: expected black, white or R,G,B with numbers in 0..1, e.g. 0.2,0.2,0.2."
        )
    return torch.tensor(color)
