"""Errors of fits to bodies held out of a corpus, against the number of bodies that the network was trained on.

``python -m benchmarks.bodies DIR FILE.png`` draws the evaluated runs of ``experiment=pretrain_fit`` below DIR.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

from gausim.core.errors import RunError
from gausim.pictures.figures import METHOD_COLORS, made_figure, save_figure

FILE = "corpus.json"


def fitted_errors(roots: Sequence[Path]) -> dict[int, dict[int, float]]:
    """Error of unseen frames over static's by frames seen and bodies pretrained on; means over runs, such as seeds.

    Raises:
        RunError: no run below ``roots`` is an evaluated fit whose base is known, or a file is damaged.
    """
    values: dict[tuple[int, int], list[float]] = defaultdict(list)
    for file in sorted({file for root in roots for file in root.rglob(FILE)}):
        try:
            found = json.loads(file.read_text())
            seen, bodies, error = found["seen"], found["pretrained"], float(found["all"]["error"][2])
        except (ValueError, KeyError, TypeError, IndexError) as problem:
            raise RunError(
                f"{file}: damaged or of an earlier version ({problem!r}). `gausim evaluate` it."
            ) from problem
        if bodies is not None:
            values[int(seen), int(bodies)].append(error)
    if not values:
        raise RunError(
            f"{' '.join(map(str, roots))}: no fit to bodies of a corpus is evaluated here. Make one with `gausim train "
            "experiment=pretrain_fit init_from=BASE`, then `gausim evaluate RUN`."
        )
    return {
        frames: {n: fmean(own) for (seen, n), own in sorted(values.items()) if seen == frames}
        for frames in sorted({seen for seen, _ in values})
    }


def bodies_figure(errors: Mapping[int, Mapping[int, float]], path: Path) -> None:
    """Draws what :func:`fitted_errors` returns, one line per number of frames seen."""
    figure, (axes,) = made_figure(1, 1, (5.0, 3.4))
    for (frames, line), color in zip(errors.items(), METHOD_COLORS, strict=False):
        axes.plot(list(line), list(line.values()), "o-", color=color, label=f"{frames} frames seen")
    axes.axhline(1.0, linestyle="--", color="#555555", linewidth=1.0, label="static")
    counts = sorted({count for line in errors.values() for count in line})
    if counts[0] > 0:
        axes.set_xscale("log")
    else:  # a network that has seen no body
        axes.set_xscale("symlog", linthresh=10)
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.set(xlabel="bodies pretrained on", ylabel="3D error of unseen frames ÷ static", ylim=(0, None))
    axes.legend(fontsize=7)
    save_figure(figure, path)


def main(argv: Sequence[str]) -> int:
    """Draws and prints the errors of the runs below a folder."""
    folder, target = map(Path, argv)
    errors = fitted_errors([folder])
    bodies_figure(errors, target)
    for frames, line in errors.items():
        print(f"{frames} frames seen: " + ", ".join(f"{error:.3f} with {n} bodies" for n, error in line.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
