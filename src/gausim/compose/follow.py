"""Program of the ranks that the first one starts: `python -m gausim.compose.follow RUN_DIRECTORY`."""

import sys

from gausim.compose.build import opened
from gausim.compose.train import train
from gausim.core import GausSimError
from gausim.runs.directory import RunDirectory


def main() -> int:
    """Trains as a follower, by the saved configuration of the run; returns the exit status."""
    run = RunDirectory(sys.argv[1])
    try:
        train(opened(run.config()), run)
    except GausSimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
