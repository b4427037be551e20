"""What the stages' command lines have in common."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gausim.core.errors import GausSimError


def add_result(parser: argparse.ArgumentParser) -> None:
    """Adds where the result goes, and whether it may replace another."""
    parser.add_argument("--out", type=Path, required=True, help="folder of the result")
    parser.add_argument("--force", action="store_true", help="replace a result of other inputs or settings")


def headline(out: Path, manifest: Mapping[str, Any]) -> str:
    """The first line that a stage prints when it is done."""
    return f"{out}: {'made' if manifest['made'] else 'there already'}"


def told(run: Callable[[], str]) -> int:
    """Runs a stage, prints what it returns, and turns what went wrong into a line on standard error.

    Returns:
        The exit code: 0, 2 after an error, 130 where the user has interrupted it.
    """
    try:
        text = run()
    except (GausSimError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted. The same command goes on where it was.", file=sys.stderr)
        return 130
    print(text)
    return 0
