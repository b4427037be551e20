"""`gausim prepare WHAT`: fetches what gausim needs and does not ship."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

HELP = "Fetch what is not part of gausim: the LPIPS weights."


def main(argv: Sequence[str]) -> int:
    """Runs the command.

    Args:
        argv: the arguments after the command's name.

    Returns:
        The exit status.

    Raises:
        DataError: something cannot be fetched or read, or is not what was published.
    """
    arguments = _parser().parse_args(argv)
    status: int = arguments.run(arguments)
    return status


def _parser() -> argparse.ArgumentParser:
    from gausim.cli import prepare_lpips as _prepare_lpips

    parser = argparse.ArgumentParser(prog="gausim prepare", description=HELP)
    parts = parser.add_subparsers(metavar="WHAT", required=True)
    _prepare_lpips.add_to(parts)
    return parser
