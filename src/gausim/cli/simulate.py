"""`gausim simulate RUN`: videos, space-time slices, error plots and trajectories of a run's predictions."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausim.cli.arguments import UPS, add_data_option, add_scene_options, command_parser, parse_background, positive
from gausim.core.errors import ConfigError


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    parse_background(arguments.background)  # raises on a wrong value before the simulation
    if (arguments.run is None) == (arguments.scene is None):
        raise ConfigError("expected a RUN, or --scene SCENE.ply and the run whose network moves it, --from RUN.")
    if arguments.scene is not None:
        from gausim.cli.simulate_run import simulate_scene

        return simulate_scene(arguments)
    from gausim.cli.simulate_run import simulate_run

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
    add("run", metavar="RUN", nargs="?", type=Path, help="run directory of `gausim train`")
    add("--object", nargs="+", metavar="NAME", help="only these objects")
    add("--sequence", nargs="+", metavar="NAME", help="sequences, or `all`; default the first of each object")
    add("--frames", type=positive, metavar="N", help="frames to predict; default as many as were recorded")
    add("--view", nargs="+", metavar="NAME", help="cameras; default the first trained and the first held-out one")
    add_data_option(parser)
    add("--out", metavar="DIR", type=Path, help="folder to write; default RUN/simulation")
    add("--background", default="black", metavar="COLOR", help="black, white or R,G,B in 0..1 (default: black)")
    add("--brighten", type=float, default=1.0, metavar="GAIN", help="gain of the pictures; numbers are never touched")
    add("--slow", type=float, default=1.0, metavar="FACTOR", help="slow motion of the videos, e.g. 3")
    add("--gif", action="store_true", help="write GIFs besides")
    add("--verbose", action="store_true", help="list the files that are written")
    add_force_options(parser)
    group = add_scene_options(parser)
    group.add_argument(
        "--scene", metavar="SCENE.ply", type=Path, help="3DGS scene; give --from, and pins if it has none"
    )
    group.add_argument("--up", choices=UPS, default="z", help="vertical axis of the scene (write --up=-y; default: z)")
    group.add_argument("--azimuth", type=float, default=0.0, metavar="DEGREES", help="of the camera (default: 0)")
    return parser
