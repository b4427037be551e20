"""Colours of the synthetic objects: a smooth gradient, spots to see the motion by, and a baked soft light."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_prep.synthetic.bodies import Array, Ints

LIGHT = np.array([0.4, -0.5, 0.77])


def paint(body: str, x: Array, normal: Array, grid: Ints, rng: np.random.Generator) -> Array:
    """RGB (K, 3) of a kind of body at points ``x`` in cells ``grid``."""
    painter, count, radius = PAINTERS[body]
    color = painter(x, grid)
    for center in x[rng.choice(len(x), count, replace=False)]:
        weight = np.exp(-((((x - center) ** 2).sum(1) / radius**2) ** 2))[:, None]
        color = (1 - weight) * color + weight * rng.uniform(0.05, 0.95, 3)
    # Half-Lambert light from above, part of the colour as in a 3DGS capture.
    light = LIGHT / np.linalg.norm(LIGHT)
    return np.clip(color * (0.62 + 0.38 * (0.5 + 0.5 * normal @ light))[:, None], 0.02, 0.98)


def _pudding(x: Array, grid: Ints) -> Array:
    """Custard below, caramel on top, with cherries."""
    height = (x[:, 2] - x[:, 2].min()) / np.ptp(x[:, 2])
    custard, caramel = np.array([0.95, 0.82, 0.5]), np.array([0.55, 0.27, 0.1])
    top = 1 / (1 + np.exp(-14 * (height - 0.72 - 0.08 * np.sin(4 * np.arctan2(x[:, 1], x[:, 0])))))[:, None]
    return (1 - top) * custard + top * caramel


def _flower(x: Array, grid: Ints) -> Array:
    """Green stem and leaf, pink petals around a yellow heart."""
    color = np.tile([0.3, 0.58, 0.22], (len(x), 1))
    color[grid[:, 0] > 2] = [0.16, 0.45, 0.2]
    blossom = grid[:, 2] == grid[:, 2].max()
    center = x[blossom].mean(0)
    radius = np.linalg.norm(x - center, axis=1) / np.linalg.norm(x[blossom] - center, axis=1).max()
    petal = np.array([0.93, 0.4, 0.6]) * (1 - 0.35 * radius[:, None]) + [0.05, 0.0, 0.12]
    heart = np.exp(-((radius / 0.38) ** 4))[:, None]
    color[blossom] = (heart * [0.98, 0.8, 0.2] + (1 - heart) * petal)[blossom]
    return color


def _potted(x: Array, grid: Ints) -> Array:
    """A terracotta pot with a painted band, striped stem, veined leaves and petals, and a heart of seeds."""
    i, j, k = grid.T
    top = k.max()
    along = np.maximum(np.abs(i - 2), np.abs(j - 2)) - 2  # cells beyond the disc
    color = (
        np.array([0.36, 0.62, 0.25]) * (0.8 + 0.2 * np.sin(90 * x[:, 2] + 12 * np.arctan2(x[:, 1], x[:, 0])))[:, None]
    )

    leaf = (k < top) & (k >= 2) & (i != 2)
    vein = np.cos(55 * np.abs(x[:, 1]) - 60 * np.abs(x[:, 0])) > 0.75
    ribs = vein | (np.abs(x[:, 1]) < 0.006)
    color[leaf] = np.where(ribs[:, None], [0.55, 0.75, 0.38], [0.13, 0.42, 0.2])[leaf]

    pot = k < 2
    angle, height = np.arctan2(x[:, 1], x[:, 0]), x[:, 2]
    zigzag = np.abs(height - 0.16 - 0.03 * (2 / np.pi) * np.arcsin(np.sin(9 * angle))) < 0.014
    bands = (np.abs(height - 0.085) < 0.008) | (np.abs(height - 0.235) < 0.008)
    dots = ((np.mod(9 * angle / np.pi, 1) - 0.5) ** 2 + ((height - 0.262) / 0.03) ** 2) < 0.1
    glaze = np.select([zigzag, bands, dots], [0, 1, 2], 3)
    color[pot] = np.array([[0.95, 0.9, 0.78], [0.16, 0.34, 0.5], [0.95, 0.9, 0.78], [0.74, 0.36, 0.22]])[glaze][pot]
    soil = pot & (height > 0.2999)
    grain = 0.5 + 0.5 * np.sin(190 * x[:, 0]) * np.sin(170 * x[:, 1])
    color[soil] = (np.array([0.2, 0.13, 0.09]) + 0.12 * grain[:, None])[soil]

    blossom = k == top
    centre = x[blossom & (along <= 0)].mean(0)
    flat = (x - centre)[:, :2] * [1 / np.cos(0.75), 1.0]
    radius, angle = np.hypot(*flat.T), np.arctan2(flat[:, 1], flat[:, 0])
    fine = 0.5 + 0.5 * np.cos(12 * 7 * angle)
    shade = np.clip((radius - 0.12) / 0.27, 0, 1)[:, None]
    petal = (
        (1 - shade) * [0.72, 0.08, 0.3] + shade * [0.98, 0.62, 0.68] - 0.13 * (fine * (1 - 0.6 * shade[:, 0]))[:, None]
    )
    color[blossom] = petal[blossom]
    heart = blossom & (along <= 0)
    seeds = np.cos(13 * angle - 130 * radius) * np.cos(13 * angle + 130 * radius)
    rim = np.clip((radius - 0.07) / 0.04, 0, 1)[:, None]
    seed = (1 - rim) * [0.36, 0.2, 0.07] + rim * [0.96, 0.7, 0.12]
    color[heart] = (seed * (0.8 + 0.35 * (seeds > 0.1))[:, None])[heart]
    return color


def _jelly(x: Array, grid: Ints) -> Array:
    """Raspberry on one side, mint on the other, with fruits."""
    side = (x - x.min(0)) / np.ptp(x, axis=0) @ np.array([0.5, 0.2, 0.3])
    mint = 1 / (1 + np.exp(-12 * (side - 0.5 - 0.06 * np.sin(9 * x[:, 1]))))[:, None]
    return (1 - mint) * [0.85, 0.2, 0.35] + mint * [0.35, 0.8, 0.6]


def _bar(x: Array, grid: Ints) -> Array:
    """Bands along the bar from blue to orange."""
    along = ((x[:, 0] - x[:, 0].min()) / np.ptp(x[:, 0]))[:, None]
    band = 0.75 + 0.25 * np.sin(40 * along)
    return band * ((1 - along) * [0.2, 0.35, 0.85] + along * [0.95, 0.55, 0.15])


# Of each body its colours, and how many dabs of random colours it has, of which radius [scene units].
PAINTERS: dict[str, tuple[Callable[[Array, Ints], Array], int, float]] = {
    "pudding": (_pudding, 26, 0.075), "flower": (_flower, 22, 0.06), "potted": (_potted, 0, 1.0),
    "jelly": (_jelly, 60, 0.1), "bar": (_bar, 40, 0.055),
}  # fmt: skip
