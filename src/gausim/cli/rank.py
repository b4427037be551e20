"""One more rank of a run: started by the first one, which tells it what to train. Not a command for people."""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(argv: Sequence[str]) -> int:
    """Trains along until the first rank is done or gone; returns the exit status."""
    from gausim.cli.train import follow
    from gausim.core import GausSimError
    from gausim.training.ranks.launch import Crew, end_with_first
    from gausim.training.ranks.layout import Layout, Place

    end_with_first()
    place = Place.parse(argv)
    try:
        with Crew(Layout(place.size), place=place) as crew:
            follow(crew)
    except GausSimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
