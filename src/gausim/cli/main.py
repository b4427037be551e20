"""The `gausim` command: picks a sub-command and imports only that one, so that `gausim --help` stays instant."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import NamedTuple

from gausim import __version__

EXIT_OK = 0
EXIT_USAGE = 2
# 128 + SIGINT, what shells report for an interrupted program.
EXIT_INTERRUPTED = 130


class Command(NamedTuple):
    """A sub-command: the module whose `main(argv)` runs it, and one line of help.

    The line is repeated from the module's `HELP` because reading it there would import the module (a test keeps the
    two equal).
    """

    module: str
    help: str


COMMANDS: dict[str, Command] = {
    "prepare": Command(
        "gausim.cli.prepare", "Make a data set of films and photos, stage by stage; fetch the LPIPS weights."
    ),
    "inspect": Command("gausim.cli.inspect", "Print a scene's kernels and hierarchy and draw its clusters."),
    "reconstruct": Command("gausim.cli.reconstruct", "Fit the Gaussians of the rest scene to posed stills."),
    "verify": Command("gausim.cli.verify", "Check a data set and name every fault."),
    "doctor": Command(
        "gausim.cli.doctor",
        "Look at cameras, masks, clock and motion of a data set before training: what to mend.",
    ),
    "train": Command("gausim.cli.train", "Learn an object's dynamics from multi-view videos."),
    "adapt": Command(
        "gausim.cli.adapt", "Fit how new sequences begin to their first frames, with a trained run as it is."
    ),
    "evaluate": Command("gausim.cli.evaluate", "Measure a run on seen, unseen and held-out frames."),
    "benchmark": Command(
        "gausim.cli.benchmark",
        "Measure the speed of rendering, stepping, training and clustering as ratios within one run.",
    ),
    "simulate": Command(
        "gausim.cli.simulate.command", "Roll a run forward and write videos, figures and trajectories."
    ),
    "view": Command("gausim.cli.view", "Show a run or a scene in the browser and pull it about."),
    "export": Command(
        "gausim.cli.export", "Write a motion as PLY, OpenUSD, safetensors, viser, HTML, MP4 or GIF, and read it back."
    ),
    "config": Command(
        "gausim.cli.config", "Check a training configuration, print its JSON schema, complete it in the shell."
    ),
    "card": Command("gausim.cli.card", "Write the card of a run: data, figures, cost, limitations, licence."),
    "fetch": Command("gausim.cli.fetch", "Fetch a published run or data set, or pack one for others."),
    "report": Command("gausim.cli.report", "Compare runs and sweeps: one HTML page, Markdown, LaTeX and CSV."),
}


def usage() -> str:
    """Returns the text of `gausim --help`."""
    width = max(len(name) for name in COMMANDS)
    commands = "\n".join(f"  {name:<{width}}  {command.help}" for name, command in COMMANDS.items())
    return (
        "usage: gausim COMMAND [ARGUMENTS]\n\n"
        "Learn, compare and play with neural simulators of elastic objects made of 3D Gaussians.\n\n"
        f"commands:\n{commands}\n\n"
        "options:\n"
        "  -h, --help     Show this text; `gausim COMMAND --help` explains a command.\n"
        "  -V, --version  Show the version.\n\n"
        "GAUSIM_DEBUG=1 in the environment shows the traceback of every error."
    )


def _unknown(name: str) -> str:
    matches = difflib.get_close_matches(name, COMMANDS, n=1)
    hint = f"Did you mean {matches[0]!r}?" if matches else f"Choose one of: {', '.join(COMMANDS)}."
    return f"error: unknown command {name!r}. {hint} `gausim --help` lists the commands."


def _explain(error: BaseException) -> int | None:
    """Prints an error meant for people as one line and returns its exit status; None: it is a defect, not a message."""
    if isinstance(error, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    # Imported only now: gausim.core loads torch, which `gausim --help` must not wait for.
    from gausim.core.errors import GausSimError

    if isinstance(error, GausSimError):
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USAGE
    return None


def run_command(command: Command, argv: Sequence[str]) -> int:
    """Imports and runs one sub-command, turning the errors meant for people into one line.

    Args:
        command: what to run.
        argv: the arguments after the command's name.

    Returns:
        The exit status.

    Raises:
        Exception: what is no GausSimError is a defect and keeps its traceback; GAUSIM_DEBUG=1 shows them all.
    """
    try:
        return int(importlib.import_module(command.module).main(list(argv)))
    except (Exception, KeyboardInterrupt) as error:
        status = None if os.environ.get("GAUSIM_DEBUG", "") not in ("", "0") else _explain(error)
        if status is None:
            raise
        return status


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        argv: arguments without the program's name; the process's own by default.

    Returns:
        The exit status: 0 when it worked, 2 on wrong usage or unusable input, 130 when interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments:
        print(usage(), file=sys.stderr)
        return EXIT_USAGE
    name, rest = arguments[0], arguments[1:]
    if name in ("-h", "--help", "help"):
        print(usage())
        return EXIT_OK
    if name in ("-V", "--version"):
        print(f"gausim {__version__}")
        return EXIT_OK
    if name not in COMMANDS:
        print(_unknown(name), file=sys.stderr)
        return EXIT_USAGE
    # torch's operators are small here and gain little from a second thread, which spins while it waits and takes the
    # core from whoever else runs. The renderer's workers (render.threads) sleep.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return run_command(COMMANDS[name], rest)


if __name__ == "__main__":
    raise SystemExit(main())
