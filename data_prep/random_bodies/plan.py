"""Plan of a corpus: how many bodies, and the ranges that everything about them is drawn from."""

from __future__ import annotations

from dataclasses import dataclass

from data_prep.common.command import Options, option

RATES = (24, 30, 60)  # frames per second
PERIODS = (4.0, 40.0)  # of the slowest mode [frames]
DENSITIES = (10.0, 1000.0)  # mean of a body [mass / scene unit^3]
DAMPING_RATIOS = (0.003, 0.3)  # of the slowest mode, relative to critical damping
DIAGONALS = (0.5, 3.0)  # [scene units]
POISSON_RATIOS = (0.2, 0.42)
CELLS = (110, 260)  # hexahedral cells of a body, each of six tetrahedra, unless more are asked for
SHAPES = ("blob", "superquadric", "stem", "slab", "shell", "fork", "lattice", "ring", "figure")
MATERIALS = ("even", "even", "split", "smooth")  # half of the bodies are even
CONTRASTS = (2.0, 30.0)  # of stiffness within an uneven body
HALVES = (0.35, 0.65)  # part of a body on one side of the plane between its halves
# A sequence is kept if its largest displacement lies here [diagonals] and no volume shrinks below a fraction.
KEPT_SWING, LEAST_VOLUME = (0.015, 0.45), 0.1


@dataclass(frozen=True)
class Plan(Options):
    """Size of a corpus."""

    bodies: int = option(300, "make so many bodies (300)", least=1)
    sequences: int = option(4, "make so many sequences per body (4)", least=1)
    frames: int = option(50, "make so many frames per sequence (50)", least=2)
    kernels: tuple[int, int] = option(
        (400, 800),
        "give a body between FEWEST and MOST kernels (400 800)",
        least=50,
        interval=True,
        metavar=("FEWEST", "MOST"),
    )
    cells: tuple[int, int] = option(
        CELLS, "give a body between FEWEST and MOST hexahedral cells, each of six linear elements (110 260)", least=50,
        interval=True, metavar=("FEWEST", "MOST"),
    )  # fmt: skip
    shapes: tuple[str, ...] = option(
        SHAPES, "draw from these kinds of shape, each as likely as the others "
        f"({' '.join(SHAPES)}); besides these there is: bar",
        nargs="+", choices=(*SHAPES, "bar"), metavar="KIND",
    )  # fmt: skip
    materials: tuple[str, ...] = option(
        MATERIALS, "draw from these kinds of material (even even split smooth): even, split at any plane, smooth, or "
        "halves differing in stiffness alone", nargs="+", choices=("even", "split", "halves", "smooth"), metavar="KIND",
    )  # fmt: skip
    swing: tuple[float, float] = option(
        (0.02, 0.3), "push by amplitudes from LOW to HIGH [fractions of the body's diagonal] (0.02 0.3)",
        least=1e-3, most=0.4, interval=True,
    )  # fmt: skip
    seed: int = option(0, "draw everything random with this seed (0)", least=0)
