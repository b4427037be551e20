"""Motion of a body: random pushes as sums of its slow modes, and what follows from one by finite elements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np
from scipy.spatial import cKDTree

from data_prep.random_bodies.matter import Matter, Modes
from data_prep.random_bodies.shapes import Rng
from data_prep.synthetic.bodies import Array, Body
from data_prep.synthetic.elastic import ElasticBody
from data_prep.synthetic.embedding import Embedding
from data_prep.synthetic.plan import Material
from gausim.data.corpus import Kind, Start

KINDS: tuple[Kind, ...] = get_args(Kind)
RELEASED = 0.35  # of the sequences start at the first turn of the motion
SMALLER = 1.5  # exponent that makes small pushes more frequent than large ones
WIDTH = 0.28  # of a poke [diagonals]
# Slowest modes that a push may excite: those slower than this [frames], but never fewer than LEAST_MODES.
FASTEST_PERIOD, LEAST_MODES = 2.5, 3
# Of the step 2 / omega at which the fastest mode at rest would explode: bodies stiffen as they stretch.
STEP_FRACTION = 0.65


@dataclass(frozen=True)
class Push:
    """One push."""

    kind: Kind
    start: Start
    direction: tuple[float, float, float]
    amplitude: float  # largest displacement by linear modes [diagonals]


def random_push(rng: Rng, swing: tuple[float, float]) -> Push:
    """A push of a random amplitude within ``swing`` [diagonals]."""
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    start: Start = "release" if rng.random() < RELEASED else "impulse"
    amplitude = float(swing[0] + (swing[1] - swing[0]) * rng.random() ** SMALLER)
    return Push(KINDS[int(rng.integers(len(KINDS)))], start, tuple(direction.tolist()), amplitude)


def push_velocity(body: Body, masses: Array, modes: Modes, push: Push, fps: float, rng: Rng) -> Array:
    """Initial velocity (N, 3) of a push, made of slow modes and scaled to its amplitude."""
    distance, direction = cKDTree(body.nodes[body.held]).query(body.nodes)[0], np.array(push.direction)
    weight = distance / distance.max()
    if push.kind == "twist":
        field = weight[:, None] * np.cross(direction, body.nodes - np.average(body.nodes, axis=0, weights=weight))
    else:
        if push.kind == "poke":
            place = body.nodes[rng.choice(np.flatnonzero(weight > 0.4))]
            apart = np.linalg.norm(body.nodes - place, axis=1) / (WIDTH * body.diagonal)
            weight = weight * np.exp(-0.5 * apart**2)
        else:
            weight = weight**1.5
        field = weight[:, None] * direction
    slow = max(LEAST_MODES, int((modes.omega < 2 * np.pi * fps / FASTEST_PERIOD).sum()))
    shapes, omega = modes.shapes[:slow], modes.omega[:slow]
    amount = np.einsum("mnx,nx,n->m", shapes, field, masses)
    times = np.linspace(0, 0.75, 25)[1:, None] * 2 * np.pi / omega[0]
    swing = np.einsum("tm,mnx->tnx", amount / omega * np.sin(times * omega), shapes)
    peak = np.linalg.norm(swing, axis=-1).max() / body.diagonal
    return np.einsum("m,mnx->nx", amount, shapes) * (push.amplitude / peak)


class FiniteElements:
    """Linear tetrahedra of St. Venant and Kirchhoff's material by MuJoCo, uneven by element."""

    def __init__(self, points: Embedding, matter: Matter, modes: Modes, *, fps: float) -> None:
        body = points.body
        masses = matter.node_masses(body)
        material = Material(1.0, matter.poisson_ratio, 0.0, float(masses.sum()))
        self._points = points
        self._elastic = ElasticBody(body, material, fps=fps, time_step=2 * STEP_FRACTION / modes.highest)
        self._elastic.set_uneven(np.tile(matter.young_modulus, 6), masses, matter.node_drag(body))

    def simulate(self, velocity: Array, frames: int) -> tuple[Array, float]:
        """Positions (F, K, 3) after an initial node velocity (N, 3), frame 0 at rest, and the least relative volume.

        Raises:
            DivergenceError: the motion left the finite numbers.
        """
        nodes = self._elastic.simulate(velocity, frames)
        volume = np.linalg.det(self._points.deformation_gradients(nodes)).min()
        return self._points.positions(nodes), float(volume)
