"""Figures of the GausSim paper as reference rows, measured on its recordings and cameras."""

import re

Pair = tuple[float, float]

OBJECTS = ("mothorchids", "carnation", "pudding", "duck", "bunny")
METHODS = ("DreamGaussian4D (paper)", "PhysDreamer (paper)", "GausSim (paper)")
# The unseen frames are 16..99 on the first three objects and 16..49 on the last two.
LATE = ("mothorchids", "carnation", "pudding")

# metric -> method -> object -> (seen, unseen), each (mean, standard deviation over sequences), as printed
_L2 = """
3.26 .61 11.32 3.09  6.20 .85 31.63 5.10  2.13 .23 6.71 .49  2.65 .59 4.61 1.07  1.21 .11 3.10 .63
5.97 .76 2.59 .27  7.23 .91 6.15 .84  2.31 .34 1.79 .28  2.73 .67 2.49 .62  4.77 .45 3.62 .31
1.78 .23 1.85 .14  3.69 .36 6.02 .75  1.12 .01 1.16 .01  2.21 .48 2.36 .48  1.15 .12 2.47 .40"""
_SSIM = """
9.89 .02 9.82 .03  9.80 .01 9.65 .03  9.91 .00 9.88 .01  9.93 .00 9.92 .00  9.96 .00 9.91 .00
9.76 .02 9.86 .02  9.71 .02 9.73 .02  9.91 .00 9.92 .00  9.91 .00 9.92 .01  9.89 .00 9.86 .00
9.90 .01 9.90 .01  9.81 .01 9.74 .02  9.95 .00 9.95 .00  9.94 .01 9.95 .01  9.97 .00 9.93 .01"""
_LPIPS = """
2.54 .21 3.41 .54  4.00 .19 7.00 .61  1.42 .03 1.72 .05  1.52 .13 1.82 .14  .27 .02 .69 .01
3.62 .24 2.77 .11  4.56 .27 5.66 .54  1.38 .02 1.23 .04  1.41 .15 1.32 .17  1.67 .19 .89 .13
2.46 .10 2.47 .07  3.91 .16 5.10 .58  1.13 .03 1.17 .04  1.18 .18 1.23 .19  .21 .02 .49 .08"""


def _table(text: str) -> dict[str, dict[str, tuple[Pair, Pair]]]:
    rows = {}
    for method, line in zip(METHODS, text.strip().splitlines(), strict=True):
        n = [float(x) for x in line.split()]
        parts = [((n[i], n[i + 1]), (n[i + 2], n[i + 3])) for i in range(0, len(n), 4)]
        rows[method] = dict(zip(OBJECTS, parts, strict=True))
    return rows


# Printed numbers: l2 x 1e-3, SSIM x 1e-1, LPIPS x 1e-2.
TABLES = {"l2": _table(_L2), "ssim": _table(_SSIM), "lpips": _table(_LPIPS)}

# Ablations, l2 x 1e-3 on Mothorchids: variation -> (seen, unseen).
ABLATION: dict[str, tuple[Pair, Pair]] = {
    "full": ((1.78, 0.23), (1.85, 0.14)),
    "jointly": ((1.90, 0.54), (1.88, 0.18)),
    "w/o mass": ((2.19, 0.52), (1.90, 0.16)),
    "w/o momentum": ((2.64, 0.62), (1.91, 0.17)),
}
ABLATION_OBJECT = "mothorchids"

# Method -> (seconds per frame, gigabytes), 23422 kernels on one A100, drawing included as the paper measures it.
EFFICIENCY: dict[str, tuple[float, float]] = {
    "DreamGaussian4D (paper)": (0.14, 7.6),
    "PhysDreamer (paper)": (1.67, 4.6),
    "GausSim w/o hierarchy (paper)": (0.36, 3.5),
    "GausSim (paper)": (0.13, 2.1),
}


def paper_object(name: str) -> str | None:
    """The paper's object of that name: one of its words is the paper's, as in ``bunny_ready``."""
    words = set(re.split(r"[^a-z]+", name.lower()))
    return next((o for o in OBJECTS if o in words), None)
