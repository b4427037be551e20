"""The `gausim` command: picks a sub-command and imports only that one, so that `gausim --help` stays instant."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from collections.abc import Callable, Sequence

from gausim import __version__

EXIT_OK = 0
EXIT_USAGE = 2
# 128 + SIGINT, what shells report for an interrupted program.
EXIT_INTERRUPTED = 130
# Each is a module beside this one, whose `main(argv)` runs it.
COMMANDS = {
    "prepare": "Make a data set of films and photos, stage by stage; fetch the LPIPS weights.",
    "inspect": "Print a scene's kernels and hierarchy and draw its clusters.",
    "reconstruct": "Fit the Gaussians of the rest scene to posed stills.",
    "verify": "Check a data set and name every fault.",
    "doctor": "Look at cameras, masks, clock and motion of a data set before training: what to mend.",
    "train": "Learn an object's dynamics from multi-view videos.",
    "adapt": "Fit how new sequences begin to their first frames, with a trained run as it is.",
    "evaluate": "Measure a run on seen, unseen and held-out frames.",
    "benchmark": "Measure the speed of rendering, stepping, training and clustering as ratios within one run.",
    "simulate": "Roll a run forward and write videos, figures and trajectories.",
    "view": "Show a run or a scene in the browser and pull it about.",
    "export": "Write a motion as PLY, OpenUSD, safetensors, viser, HTML, MP4 or GIF, and read it back.",
    "config": "Check a training configuration, print its JSON schema, complete it in the shell.",
    "card": "Write the card of a run: data, figures, cost, limitations, licence.",
    "fetch": "Fetch a published run or data set, or pack one for others.",
    "report": "Compare runs and sweeps: one HTML page, Markdown, LaTeX and CSV.",
}


def usage() -> str:
    """Returns the text of `gausim --help`."""
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:<{width}}  {line}" for name, line in COMMANDS.items())
    return (
        "usage: gausim COMMAND [ARGUMENTS]\n\n"
        "Learn, compare and play with neural simulators of elastic objects made of 3D Gaussians.\n\n"
        f"commands:\n{commands}\n\n"
        "options:\n"
        "  -h, --help     Show this text; `gausim COMMAND --help` explains a command.\n"
        "  -V, --version  Show the version.\n\n"
        "GAUSIM_DEBUG=1 in the environment shows the traceback of every error."
    )


def command(name: str) -> Callable[[list[str]], int]:
    """Imports a command; what is returned runs it."""
    run: Callable[[list[str]], int] = importlib.import_module(f"gausim.cli.{name}").main
    return run


def _unknown(name: str) -> str:
    matches = difflib.get_close_matches(name, COMMANDS, n=1)
    hint = f"Did you mean {matches[0]!r}?" if matches else f"Choose one of: {', '.join(COMMANDS)}."
    return f"error: unknown command {name!r}. {hint} `gausim --help` lists the commands."


def _run(name: str, argv: list[str]) -> int:
    """Runs a command; an error meant for people becomes one line, a defect keeps its traceback."""
    try:
        return int(command(name)(argv))
    except (Exception, KeyboardInterrupt) as error:
        if os.environ.get("GAUSIM_DEBUG", "") not in ("", "0"):
            raise
        if isinstance(error, KeyboardInterrupt):
            print("interrupted", file=sys.stderr)
            return EXIT_INTERRUPTED
        # Imported only now: gausim.core loads torch, which `gausim --help` must not wait for.
        from gausim.core.errors import GausSimError

        if not isinstance(error, GausSimError):
            raise
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USAGE


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        argv: arguments without the program's name; the process's own by default.

    Returns:
        The exit status: 0 done, 2 wrong usage or unusable input, 130 interrupted, else the command's own.
    """
    name, *rest = list(sys.argv[1:] if argv is None else argv) or [""]
    if name in ("-h", "--help", "help"):
        print(usage())
        return EXIT_OK
    if name in ("-V", "--version"):
        print(f"gausim {__version__}")
        return EXIT_OK
    if name not in COMMANDS:
        print(_unknown(name) if name else usage(), file=sys.stderr)
        return EXIT_USAGE
    # torch's operators are small here and gain little from a second thread, which spins while it waits and takes the
    # core from whoever else runs. The renderer's workers (render.threads) sleep.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return _run(name, rest)


if __name__ == "__main__":
    raise SystemExit(main())
