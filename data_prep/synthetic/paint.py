"""Colours of the synthetic objects: a smooth gradient, spots to see the motion by, and a baked soft light."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_prep.synthetic.bodies import Array, Ints

LIGHT = np.array([0.4, -0.5, 0.77])


def paint_pudding(x: Array, normal: Array, grid: Ints, rng: np.random.Generator) -> Array:
    """Custard below, caramel on top, with cherries: RGB (K, 3) at points ``x``."""
    height = (x[:, 2] - x[:, 2].min()) / np.ptp(x[:, 2])
    custard, caramel = np.array([0.95, 0.82, 0.5]), np.array([0.55, 0.27, 0.1])
    top = 1 / (1 + np.exp(-14 * (height - 0.72 - 0.08 * np.sin(4 * np.arctan2(x[:, 1], x[:, 0])))))
    return _shade(_spots((1 - top)[:, None] * custard + top[:, None] * caramel, x, 26, 0.075, rng), normal)


def paint_flower(x: Array, normal: Array, grid: Ints, rng: np.random.Generator) -> Array:
    """Green stem and leaf, pink petals around a yellow heart: RGB (K, 3) at points ``x`` in cells ``grid``."""
    color = np.tile([0.3, 0.58, 0.22], (len(x), 1))
    color[grid[:, 0] > 2] = [0.16, 0.45, 0.2]
    blossom = grid[:, 2] == grid[:, 2].max()
    center = x[blossom].mean(0)
    radius = np.linalg.norm(x - center, axis=1) / np.linalg.norm(x[blossom] - center, axis=1).max()
    petal = np.array([0.93, 0.4, 0.6]) * (1 - 0.35 * radius[:, None]) + [0.05, 0.0, 0.12]
    heart = np.exp(-((radius / 0.38) ** 4))[:, None]
    color[blossom] = (heart * [0.98, 0.8, 0.2] + (1 - heart) * petal)[blossom]
    return _shade(_spots(color, x, 22, 0.06, rng), normal)


def paint_jelly(x: Array, normal: Array, grid: Ints, rng: np.random.Generator) -> Array:
    """Raspberry on one side, mint on the other, with fruits: RGB (K, 3) at points ``x``."""
    side = (x - x.min(0)) / np.ptp(x, axis=0) @ np.array([0.5, 0.2, 0.3])
    mint = 1 / (1 + np.exp(-12 * (side - 0.5 - 0.06 * np.sin(9 * x[:, 1]))))[:, None]
    return _shade(_spots((1 - mint) * [0.85, 0.2, 0.35] + mint * [0.35, 0.8, 0.6], x, 60, 0.1, rng), normal)


def paint_bar(x: Array, normal: Array, grid: Ints, rng: np.random.Generator) -> Array:
    """Bands along the bar from blue to orange, with spots: RGB (K, 3) at points ``x``."""
    along = ((x[:, 0] - x[:, 0].min()) / np.ptp(x[:, 0]))[:, None]
    band = 0.75 + 0.25 * np.sin(40 * along)
    color = band * ((1 - along) * [0.2, 0.35, 0.85] + along * [0.95, 0.55, 0.15])
    return _shade(_spots(color, x, 40, 0.055, rng), normal)


PAINTERS: dict[str, Callable[[Array, Array, Ints, np.random.Generator], Array]] = {
    "pudding": paint_pudding,
    "flower": paint_flower,
    "jelly": paint_jelly,
    "bar": paint_bar,
}


def _spots(color: Array, x: Array, count: int, radius: float, rng: np.random.Generator) -> Array:
    """Dabs of random colours around random points."""
    for center in x[rng.choice(len(x), count, replace=False)]:
        weight = np.exp(-((((x - center) ** 2).sum(1) / radius**2) ** 2))[:, None]
        color = (1 - weight) * color + weight * rng.uniform(0.05, 0.95, 3)
    return color


def _shade(color: Array, normal: Array) -> Array:
    """Half-Lambert light from above, part of the colour as in a 3DGS capture."""
    light = LIGHT / np.linalg.norm(LIGHT)
    return np.clip(color * (0.62 + 0.38 * (0.5 + 0.5 * normal @ light))[:, None], 0.02, 0.98)
