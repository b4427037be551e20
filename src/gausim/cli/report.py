"""`gausim report DIR…`: tables, figures and videos of runs and sweeps, as one page and as files for papers."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

HELP = "Compare runs and sweeps: one HTML page, Markdown, LaTeX and CSV."


def main(argv: list[str]) -> int:
    """Runs the command.

    Args:
        argv: the arguments after the command's name.

    Returns:
        The exit status.

    Raises:
        RunError: a directory is not there, or there is no run in it.
    """
    arguments = _parser().parse_args(argv)
    from gausim.report.page import summary_line
    from gausim.report.write import write_report

    out = arguments.out or arguments.dirs[0] / "report"
    study, files = write_report(
        arguments.dirs,
        out,
        title=arguments.title,
        pictures=not arguments.no_pictures,
        say=lambda text: print(text, file=sys.stderr),
    )
    print(summary_line(study))
    for path in files:
        print(f"wrote {path}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="gausim report",
        description=f"{HELP} Reads what `gausim evaluate` wrote into the runs; runs that failed, were killed or were "
        "not evaluated are shown as such.",
    )
    add = parser.add_argument
    add("dirs", metavar="DIR", type=Path, nargs="+", help="run directories, sweeps, or any folder of them")
    add("--out", metavar="DIR", type=Path, help="folder to write; default report in the first DIR")
    add("--title", default="GausSim report", help="heading (default: %(default)s)")
    add("--no-pictures", action="store_true", help="leave figures and videos out (a small page, in a second)")
    return parser
