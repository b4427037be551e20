"""The `gausim` command: imports only the chosen sub-command, so that `gausim --help` is fast."""

import difflib
import importlib
import io
import os
import sys
from collections.abc import Callable, Sequence

from gausim import __version__
from gausim.core.errors import sentence

EXIT_USAGE = 2
EXIT_PIPE = 141  # 128 + SIGPIPE
EXIT_INTERRUPTED = 130  # 128 + SIGINT, which shells report for an interrupted program
# Each command is a module of this package with a function `main(argv)`.
COMMANDS = {
    "prepare": "Make a data set from films and photos, stage by stage; fetch the LPIPS weights.",
    "inspect": "Print a scene's kernels and hierarchy and draw its clusters.",
    "reconstruct": "Fit the Gaussians of the rest scene to posed stills.",
    "verify": "Check a data set and name every fault.",
    "doctor": "Check cameras, masks, frame rate and motion of a data set before training.",
    "train": "Learn an object's dynamics from multi-view videos.",
    "adapt": "Fit initial states of new sequences to their first frames, with a trained run frozen.",
    "evaluate": "Measure a run on seen, unseen and held-out frames.",
    "simulate": "Roll a run forward and write videos, figures and trajectories.",
    "view": "Simulate a run or a scene interactively in the browser.",
    "export": "Write a page to pull the object, or a motion as HTML, PLY, OpenUSD, MP4 or GIF.",
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
    """Imports a command and returns its main function."""
    run: Callable[[list[str]], int] = importlib.import_module(f"gausim.cli.{name}").main
    return run


def _unknown(name: str) -> str:
    matches = difflib.get_close_matches(name, COMMANDS, n=1)
    hint = f"Did you mean {matches[0]!r}?" if matches else f"Choose one of: {', '.join(COMMANDS)}."
    return f"error: unknown command {name!r}. {hint} `gausim --help` lists the commands."


def _run(name: str, argv: list[str]) -> int:
    """Runs a command; errors that a user can act on are printed in one line, defects with their traceback."""
    try:
        return int(command(name)(argv))
    except (Exception, KeyboardInterrupt, SystemExit) as error:
        if isinstance(error, SystemExit) and not isinstance(error.__context__, KeyboardInterrupt):
            raise
        if os.environ.get("GAUSIM_DEBUG", "") not in ("", "0"):
            raise
        if not isinstance(error, Exception):  # Lightning makes a SystemExit of an interrupt
            print("interrupted", file=sys.stderr)
            return EXIT_INTERRUPTED
        if isinstance(error, BrokenPipeError):  # the reader, such as `head`, has seen enough
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115, the interpreter flushes it at its end
            return EXIT_PIPE
        text = sentence(error)
        if text is None:
            raise
        print(f"error: {text}", file=sys.stderr)
        return EXIT_USAGE


def _encode_anything() -> None:
    """Lets text that the terminal's encoding lacks be written as escapes, so that no command ends by it."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line; exit status: 0 done, 2 wrong usage or input, 130 interrupted, else the command's."""
    _encode_anything()
    name, *rest = list(sys.argv[1:] if argv is None else argv) or [""]
    if name in ("-h", "--help", "help"):
        print(usage())
        return 0
    if name in ("-V", "--version"):
        print(f"gausim {__version__}")
        return 0
    if name == "-sc":  # a shell that completes a line of `gausim train`, by Hydra's function for it
        line = os.environ.get("COMP_LINE", "")
        os.environ["COMP_LINE"] = line.replace(" train ", " ", 1)
        return _run("train", [name, *rest]) if " train " in line else 0
    if name not in COMMANDS:
        print(_unknown(name) if name else usage(), file=sys.stderr)
        return EXIT_USAGE
    # The operators here are small and gain little from a second thread of torch, which occupies a core while it waits.
    # The renderer's workers (render.threads) sleep instead.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    return _run(name, rest)


if __name__ == "__main__":
    raise SystemExit(main())
