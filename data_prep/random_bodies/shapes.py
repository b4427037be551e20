"""Random shapes as scalar fields on [-1, 1]^3 that are positive inside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data_prep.synthetic.bodies import Array

Rng = np.random.Generator
Field = Callable[[Array], Array]  # (P, 3) -> (P,)


def blob(rng: Rng) -> Field:
    """A sum of metaballs."""
    count = int(rng.integers(3, 7))
    centers, radii = rng.uniform(-0.5, 0.5, (count, 3)), rng.uniform(0.3, 0.5, count)
    return lambda p: np.exp(-(((p[:, None] - centers) / radii[:, None]) ** 2).sum(-1)).sum(1) - 0.5


def superquadric(rng: Rng) -> Field:
    """Between an octahedron, an ellipsoid, a cylinder and a box."""
    radii, flat, round_ = rng.uniform(0.4, 0.95, 3), *rng.uniform(1.2, 6.0, 2)

    def field(p: Array) -> Array:
        x, y, z = np.abs(p / radii).T
        return 1 - (x**flat + y**flat) ** (round_ / flat) - z**round_

    return field


def bar(rng: Rng) -> Field:
    """A straight bar with a rectangle across."""
    half = np.array([*rng.uniform(0.16, 0.26, 2), 1.0])
    return lambda p: (half - np.abs(p)).min(1)


def stem(rng: Rng) -> Field:
    """A curved stem with a head, some with a leaf."""
    height = np.linspace(0, 1, 7)
    bend, angle, top = rng.uniform(-0.4, 0.4), rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 0.6)
    side = np.array([np.cos(angle), np.sin(angle), 0.0])
    path = np.outer(bend * height**2, side) + np.outer(-1 + (1 + top) * height, [0, 0, 1.0])
    radius = rng.uniform(0.12, 0.2)
    parts = [_tube(path, radius, radius * rng.uniform(0.7, 1)), _ellipsoid(path[-1], rng.uniform(0.2, 0.42, 3))]
    if rng.random() < 0.5:
        base = path[int(rng.integers(2, 5))]
        parts.append(_tube(np.stack((base, base + 0.6 * _sideways(rng))), 0.16, 0.13))
    return _union(parts)


def slab(rng: Rng) -> Field:
    """A plate with round corners, upright or level, some with a hole."""
    half = np.array([rng.uniform(0.6, 0.95), rng.uniform(0.45, 0.95), rng.uniform(0.1, 0.18)])[rng.permutation(3)]
    thin, corner = int(half.argmin()), rng.uniform(0.02, 0.1)
    hole, center = rng.uniform(0.15, 0.3) if rng.random() < 0.4 else 0.0, rng.uniform(-0.2, 0.2, 3)

    def field(p: Array) -> Array:
        q = np.abs(p) - half + corner
        inside = corner - np.linalg.norm(np.maximum(q, 0), axis=1) - np.minimum(q.max(1), 0)
        if hole:
            inside = np.minimum(inside, np.linalg.norm(np.delete(p - center, thin, 1), axis=1) - hole)
        return inside

    return field


def shell(rng: Rng) -> Field:
    """A bowl, a dome, or a tube with or without a floor."""
    radius, wall, cut = rng.uniform(0.65, 0.85), rng.uniform(0.09, 0.13), rng.uniform(-0.1, 0.4)
    kind, floor = rng.choice(["bowl", "dome", "tube"]), rng.random() < 0.5

    def field(p: Array) -> Array:
        if kind == "tube":
            around = wall - np.abs(np.hypot(p[:, 0], p[:, 1]) - 0.7 * radius)
            plate = np.minimum(2 * wall - np.abs(p[:, 2] + 0.9 - 2 * wall), 0.7 * radius - np.hypot(p[:, 0], p[:, 1]))
            return np.minimum(np.maximum(around, plate) if floor else around, 0.9 - np.abs(p[:, 2]))
        around = wall - np.abs(np.linalg.norm(p, axis=1) - radius)
        return np.minimum(around, (cut - p[:, 2]) if kind == "bowl" else (p[:, 2] + cut))

    return field


def fork(rng: Rng) -> Field:
    """A trunk with branches, some of them branched again."""
    radius, split = rng.uniform(0.14, 0.19), np.array([0, 0, rng.uniform(-0.5, 0.1)])
    parts = [_tube(np.array([[0, 0, -0.95], split]), 1.2 * radius, radius)]
    for turn in np.arange(count := int(rng.integers(2, 5))) * 2 * np.pi / count + rng.uniform(0, 6):
        lean = rng.uniform(0.3, 0.75)
        tip = np.array([lean * np.cos(turn), lean * np.sin(turn), rng.uniform(0.4, 0.9)])
        parts.append(_tube(np.stack((split, tip)), radius, 0.8 * radius))
        if rng.random() < 0.3:
            middle = 0.5 * (split + tip)
            parts.append(_tube(np.stack((middle, middle + 0.5 * _sideways(rng))), 0.9 * radius, 0.8 * radius))
    return _union(parts)


def lattice(rng: Rng) -> Field:
    """A frame of rods along the edges of a grid."""
    counts = rng.permutation([1, 1, int(rng.integers(1, 3))])
    ends = np.meshgrid(*(np.linspace(-0.82, 0.82, c + 1) for c in counts), indexing="ij")
    nodes, radius, rods = np.stack(ends, -1), rng.uniform(0.11, 0.15), list[Field]()
    for axis in range(3):
        low = nodes.take(range(counts[axis]), axis).reshape(-1, 3)
        high = nodes.take(range(1, counts[axis] + 1), axis).reshape(-1, 3)
        rods += [_tube(np.stack(pair), radius, radius) for pair in zip(low, high, strict=True)]
    return _union(rods)


def ring(rng: Rng) -> Field:
    """A ring, or an arch that lacks a part of it."""
    angle = np.linspace(0, rng.uniform(0.5, 0.85) if rng.random() < 0.5 else 1.0, 25) * 2 * np.pi - 0.25
    wide, tall, lift = *rng.uniform(0.5, 0.8, 2), rng.uniform(-0.25, 0.25)
    path = np.stack((wide * np.cos(angle), lift * np.sin(2 * angle), tall * np.sin(angle)), 1)
    return _tube(path, *rng.uniform(0.14, 0.22, 2))


def figure(rng: Rng) -> Field:
    """A toy: a trunk with a head, ears and arms."""
    trunk = rng.uniform([0.3, 0.28, 0.35], [0.5, 0.45, 0.55])
    neck = -0.9 + 1.7 * trunk[2]
    size = rng.uniform(0.22, 0.34)
    head = np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.15, 0.15), neck + 0.8 * size])
    parts = [_ellipsoid(np.array([0, 0, -0.9 + trunk[2]]), trunk), _ellipsoid(head, np.full(3, size))]
    ears, thick = rng.uniform(0.3, 0.65), rng.uniform(0.1, 0.14)
    for side in (-1, 1):
        ear = head + [side * 0.6 * size, 0, 0.6 * size]
        parts.append(
            _tube(np.stack((ear, ear + ears * np.array([side * rng.uniform(0.1, 0.6), 0.1, 0.9]))), thick, 0.1)
        )
        shoulder = np.array([side * 0.7 * trunk[0], 0, neck - 0.25])
        if ears < 0.5:
            parts.append(_tube(np.stack((shoulder, shoulder + [side * 0.5, rng.uniform(-0.3, 0.3), -0.1])), 0.13, 0.11))
    return _union(parts)


SHAPES: dict[str, Callable[[Rng], Field]] = {
    kind.__name__: kind for kind in (blob, superquadric, stem, slab, shell, fork, lattice, ring, figure, bar)
}


def _sideways(rng: Rng) -> Array:
    turn = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(turn), np.sin(turn), rng.uniform(0.0, 0.6)])


def _ellipsoid(center: Array, radii: Array) -> Field:
    return lambda p: (1 - np.linalg.norm((p - center) / radii, axis=1)) * radii.min()


def _tube(path: Array, first: float, last: float) -> Field:
    """Around a path of points (M, 3), its radius from ``first`` to ``last``."""
    along, radius = np.diff(path, axis=0), np.linspace(first, last, len(path))

    def field(p: Array) -> Array:
        best = np.full(len(p), -np.inf)
        for start, edge, r0, r1 in zip(path[:-1], along, radius[:-1], radius[1:], strict=True):
            t = np.clip((p - start) @ edge / (edge @ edge), 0, 1)
            best = np.maximum(best, r0 + (r1 - r0) * t - np.linalg.norm(p - start - t[:, None] * edge, axis=1))
        return best

    return field


def _union(parts: list[Field]) -> Field:
    return lambda p: np.max([part(p) for part in parts], axis=0)
