"""`gausim simulate RUN`: videos, space-time slices, error plots and trajectories of a run's predictions."""

import argparse
from pathlib import Path

from gausim.cli.arguments import (
    add_data_option,
    add_device_options,
    add_names,
    command_parser,
    computing,
    parse_background,
    positive,
)


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    parse_background(arguments.background)  # raises on a wrong value before the simulation
    from gausim.cli.simulate_run import simulate_run

    computing(arguments)
    return simulate_run(arguments)


def _parser() -> argparse.ArgumentParser:
    from gausim.interaction.words import EPILOG, add_force_options

    parser = command_parser(
        "simulate",
        "\nPer sequence: trajectory.safetensors, errors.png, and per view an MP4 (ground truth |\n"
        "prediction | error), space-time slices and a contact sheet. With forces or a session:\n"
        "trajectory.safetensors, session.json, and per view an MP4 with the forces drawn, and a sheet.",
        epilog=EPILOG,
    )
    add = parser.add_argument
    add("run", metavar="RUN", type=Path, help="run directory of `gausim train`")
    add_names(parser, "objects", "simulate these objects (default: all)")
    add_names(parser, "sequences", "simulate these sequences, or `all` (default: the first of each object)")
    add_names(parser, "cameras", "draw these (default: the first trained and the first held-out one)")
    add("--frames", type=positive, metavar="N", help="predict N frames (default: as many as were recorded)")
    add_data_option(parser)
    add("--out", metavar="DIR", type=Path, help="write to this folder (default: RUN/simulation)")
    add("--background", default="black", metavar="COLOR", help="draw on black, white or R,G,B in 0..1 (default: black)")
    add("--brighten", type=float, default=1.0, metavar="GAIN", help="multiply the pictures' colours (default: 1)")
    add("--slow", type=float, default=1.0, metavar="FACTOR", help="slow the videos down, e.g. by 3 (default: 1)")
    add("--gif", action="store_true", help="write GIFs besides")
    add_device_options(parser)
    add("--verbose", action="store_true", help="list the files that are written")
    add_force_options(parser)
    return parser
