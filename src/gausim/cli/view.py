"""`gausim view RUN|SCENE`: the object in the browser, to be pulled about."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gausim.cli.view_subject import Playable
    from gausim.viewer.subject import Subject

HELP = "Show a run or a scene in the browser and pull it about."
_UP = ("x", "y", "z", "-x", "-y", "-z")


def main(argv: list[str]) -> int:
    """Runs the command until it is interrupted.

    Args:
        argv: the arguments after the command's name.

    Returns:
        The exit status.

    Raises:
        ConfigError: viser is not installed, or options are unsafe or do not go together.
        RunError: the run is missing or has no checkpoint.
        DataError: an object or sequence that is not there.
        SceneError: the scene is unusable, or nothing of it is pinned.
    """
    arguments = _parser().parse_args(argv)
    from gausim.core.errors import ConfigError

    try:
        from gausim.viewer.app import Viewer
        from gausim.viewer.guard import Door
    except ModuleNotFoundError as error:
        raise ConfigError(f"the viewer needs {error.name}: pip install 'gausim[view]'.") from error
    token = os.environ.get("GAUSIM_VIEW_TOKEN")
    door = Door(arguments.host, arguments.port, arguments.allow_remote, tuple(arguments.name), token).checked()
    viewer = Viewer(_subject(arguments), door)
    viewer.start()
    print(f"open  {viewer.url}", flush=True)
    if arguments.allow_remote:
        print("The connection is not encrypted: whoever can listen in on it reads the token.", file=sys.stderr)
    try:
        while arguments.seconds is None or arguments.seconds > 0:
            time.sleep(1.0)
            if arguments.seconds is not None:
                arguments.seconds -= 1
    finally:
        viewer.stop()
    return 0


def _parser() -> argparse.ArgumentParser:
    from gausim.cli.inspect import add_pin_options
    from gausim.compose.data_paths import add_data_option

    parser = argparse.ArgumentParser(
        prog="gausim view",
        description=f"{HELP} A scene without a run is moved by the elastic template of the untrained default model.",
        epilog="GAUSIM_VIEW_TOKEN in the environment sets the token (16 or more letters and digits) and has it asked "
        "for on 127.0.0.1 too.",
    )
    add = parser.add_argument
    add("what", metavar="RUN|SCENE.ply", type=Path, help="run directory of `gausim train`, or a 3DGS scene")
    add("--object", metavar="NAME", help="of the run; default its first")
    add("--sequence", metavar="NAME", default="rest", help="whose beginning is the initial state (default: rest)")
    add("--beside", metavar="RUN", type=Path, help="another run of the same object, to which the same is done")
    add_data_option(parser)
    add("--gravity", type=float, metavar="G", help="what makes a weight of a mass [scene units / s^2] (default: 9.81)")
    add("--up", choices=_UP, default="z", help="vertical axis of the scene (default: z)")
    add("--sessions", metavar="DIR", type=Path, help="where sessions are saved; default RUN/sessions or ./sessions")
    add("--host", default="127.0.0.1", metavar="ADDRESS", help="address to listen at (default: 127.0.0.1)")
    add("--port", type=int, default=8080, help="0 takes a free one (default: 8080)")
    add("--allow-remote", action="store_true", help="with --host: other machines may connect, with the printed token")
    add("--name", action="append", default=[], metavar="HOST", help="host name by which the page may be asked for")
    add("--seconds", type=int, metavar="N", help="stop after so many seconds; default when interrupted")
    bare = parser.add_argument_group("a scene without a run")
    bare.add_argument("--fps", type=float, default=30.0, help="frames per second (default: 30)")
    bare.add_argument("--seed", type=int, default=0, help="of the random weights (default: 0)")
    add_pin_options(parser)
    return parser


def _subject(arguments: argparse.Namespace) -> Subject:
    from gausim.cli.view_subject import subject_of
    from gausim.core.errors import ConfigError

    beside = None
    if arguments.what.is_dir():
        made = _of_run(arguments.what, arguments)
        if arguments.beside is not None:
            beside = _of_run(arguments.beside, arguments, name=made.interaction.scene.name)
    else:
        if arguments.beside is not None:
            raise ConfigError("--beside: expected a RUN before it, got a scene. Give two runs of one object.")
        made = _of_scene(arguments)
    default = arguments.what / "sessions" if arguments.what.is_dir() else Path("sessions")
    scene = made.interaction.scene
    method = made.run.module.method_name if made.run is not None else "untrained: elastic template only"
    title = f"{scene.name}: {scene.count} kernels, {method}"
    sessions = arguments.sessions or default
    return subject_of(made, title=title, beside=beside, up=arguments.up, sessions=sessions)


def _of_run(path: Path, arguments: argparse.Namespace, *, name: str | None = None) -> Playable:
    from gausim.cli.view_subject import playable_run
    from gausim.compose.build import load_run
    from gausim.compose.data_paths import data_option
    from gausim.compose.predict import state_of

    run = load_run(path, data=data_option(arguments.data))
    state_of(run)
    return playable_run(
        run, name=name or arguments.object, sequence=arguments.sequence, gravity=arguments.gravity
    )  # fmt: skip


def _of_scene(arguments: argparse.Namespace) -> Playable:
    from gausim.cli.inspect import pinned_by
    from gausim.cli.view_subject import playable_scene
    from gausim.io.ply import load_scene

    scene = pinned_by(load_scene(arguments.what), arguments.pin_below, arguments.pin_above)
    return playable_scene(scene, fps=arguments.fps, seed=arguments.seed, gravity=arguments.gravity)
