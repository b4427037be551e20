"""Random falls: where a free body starts, how fast it moves and how it spins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_prep.synthetic.bodies import Array, Body

HIGHER, ASIDE = 0.12, 0.1  # largest shift of the start from the rest state, up or down and sideways [scene units]
SIDEWAYS, UPWARDS, SPIN = 0.2, 0.3, 0.25  # largest speeds [scene units / s], [scene units / s] and [radian / s]


@dataclass(frozen=True)
class Fall:
    """One fall, from the undeformed and upright body on."""

    shift: tuple[float, float, float]  # of the body in frame 0 from its rest state [scene units]
    velocity: tuple[float, float, float]  # of its centre of mass in frame 0 [scene units / s]
    spin: tuple[float, float, float]  # angular velocity in frame 0 [radian / s]


def random_fall(rng: np.random.Generator) -> Fall:
    """A fall that lands within a few frames of the others."""
    shift = rng.uniform(-1, 1, 3) * [ASIDE, ASIDE, HIGHER]
    velocity = rng.uniform(-1, 1, 3) * [SIDEWAYS, SIDEWAYS, UPWARDS]
    spin = rng.uniform(-1, 1, 3) * SPIN
    return Fall(*(tuple(x.round(6).tolist()) for x in (shift, velocity, spin)))


def fall_field(body: Body, fall: Fall) -> Array:
    """Velocity (N, 3) of the nodes in frame 0 [scene units / s]."""
    return np.array(fall.velocity) + np.cross(fall.spin, body.nodes - body.nodes.mean(0))
