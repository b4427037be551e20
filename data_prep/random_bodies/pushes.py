"""Random pushes of a body with any pins, as sums of its slow modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np

from data_prep.random_bodies.lattice import distance_to_pins
from data_prep.random_bodies.matter import Modes
from data_prep.random_bodies.shapes import Rng
from data_prep.synthetic.bodies import Array, Body
from gausim.data.corpus import Kind, Start

KINDS: tuple[Kind, ...] = get_args(Kind)
RELEASED = 0.35  # of the sequences start at the first turn of the motion
SMALLER = 1.5  # exponent that makes small pushes more frequent than large ones
WIDTH = 0.28  # of a poke [diagonals]
# Slowest modes that a push may excite: those slower than this [frames], but never fewer than LEAST_MODES.
FASTEST_PERIOD, LEAST_MODES = 2.5, 3


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
    weight, direction = distance_to_pins(body), np.array(push.direction)
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
    velocity: Array = np.einsum("m,mnx->nx", amount, shapes) * (push.amplitude / peak)
    return velocity
