"""`gausim view RUN|SCENE`: interactive simulation of an object in the browser."""

import argparse
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from gausim.cli.arguments import (
    UPS,
    add_data_option,
    add_device_options,
    add_names,
    add_pin_option,
    command_parser,
    computing,
)
from gausim.core.errors import ConfigError

if TYPE_CHECKING:
    from gausim.viewer.subject import Subject


def main(argv: list[str]) -> int:
    """Runs the command until it is interrupted; returns the exit status."""
    arguments = _parser().parse_args(argv)
    try:
        from gausim.viewer.access import Access
        from gausim.viewer.app import Viewer
    except ModuleNotFoundError as error:
        raise ConfigError(f"the viewer needs {error.name}: pip install 'gausim[view]'.") from error
    computing(arguments)
    token = os.environ.get("GAUSIM_VIEW_TOKEN")
    access = Access(arguments.host, arguments.port, arguments.allow_remote, tuple(arguments.name), token).checked()
    viewer = Viewer(_subject(arguments), access)
    viewer.start()
    print(f"open  {viewer.url}", flush=True)
    if arguments.allow_remote:
        print("The connection is not encrypted: whoever can listen in on it reads the token.", file=sys.stderr)
    try:
        end = float("inf") if arguments.seconds is None else time.monotonic() + arguments.seconds
        while time.monotonic() < end:
            time.sleep(1.0)
    finally:
        viewer.stop()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "view",
        " A scene without a run is moved by the network of the run given by --from, or by the template of an untrained "
        "model.",
        epilog="GAUSIM_VIEW_TOKEN in the environment sets the token (16 or more letters and digits) and has it asked "
        "for on 127.0.0.1 too.",
    )
    add = parser.add_argument
    add("what", metavar="RUN|SCENE.ply", type=Path, help="run directory of `gausim train`, or a 3DGS scene")
    add_names(parser, "objects", "show this object of the run (default: its first)", several=False)
    add_names(parser, "sequences", "begin where this sequence begins (default: at rest)", several=False)
    add_data_option(parser)
    add("--gravity", type=float, metavar="G", help="set the weight of a mass [scene units / s^2] (default: 9.81)")
    add("--up", choices=UPS, default="z", help="point the scene's vertical axis so (write --up=-y; default: z)")
    add("--sessions", metavar="DIR", type=Path, help="save sessions there (default: RUN/sessions or ./sessions)")
    add("--host", default="127.0.0.1", metavar="ADDRESS", help="listen at this address (default: 127.0.0.1)")
    add("--port", type=int, default=8080, help="listen at this port, 0: at a free one (default: 8080)")
    add("--allow-remote", action="store_true", help="let other machines in by the printed token, with --host")
    add("--name", action="append", default=[], metavar="HOST", help="answer to this host name, too")
    add("--seconds", type=int, metavar="N", help="stop after so many seconds (default: when interrupted)")
    add_device_options(parser)
    add_pin_option(_scene_options(parser))
    return parser


def _scene_options(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    group = parser.add_argument_group("a scene without a run")
    add = group.add_argument
    add("--from", dest="base", metavar="RUN", type=Path, help="move the scene by the network of this run")
    add("--stiffness", type=float, metavar="S",
        help="let the slowest swing take S^(-1/2) seconds (default with --from: 1)")  # fmt: skip
    add("--damping", type=float, metavar="D",
        help="let amplitudes fall as exp(-D t / 2) [1 / s] (default with --from: 0.5)")  # fmt: skip
    add("--fps", type=float, default=30.0, help="simulate so many frames per second (default: 30)")
    add("--seed", type=int, default=0, help="draw the weights of an untrained model with this seed (default: 0)")
    return group


def _subject(arguments: argparse.Namespace) -> "Subject":
    from gausim.cli.view_subject import run_subject, scene_subject

    if not arguments.what.is_dir():
        return scene_subject(arguments)
    if arguments.pin or arguments.base:
        raise ConfigError("--pin and --from: expected with a scene only. A run has its pins and its network.")
    return run_subject(arguments)
