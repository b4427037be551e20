"""What starts the sequences at random: falls; pokes (local) and drags (wide), velocities scaled to an amplitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_prep.synthetic.bodies import Array, Body
from data_prep.synthetic.elastic import ElasticBody
from gausim.core import DivergenceError

# Frames within which a push reaches its full amplitude: half a period of the slowest object.
FIRST_SWING = 12
TRIAL_SPEED = 1.0  # [diagonals / s], of about the size that the amplitudes ask for
# Amplitude beyond which one trial does not hit it [diagonals].
LINEAR = 0.1
TOLERANCE = 0.05
# Trials that correct a speed by the whole ratio of amplitudes, and by its root: some bodies answer so steeply that
# corrections by the whole ratio turn about the amplitude.
WHOLE, HALF = 6, 6
# Pushes that are drawn at most until one turns no finite element inside out.
DRAWS = 50
# Of a fall: the largest shift of its start from the rest state, up or down and sideways [scene units], and the largest
# speeds [scene units / s], [scene units / s] and [radian / s].
HIGHER, ASIDE = 0.12, 0.1
SIDEWAYS, UPWARDS, SPIN = 0.2, 0.3, 0.25


@dataclass(frozen=True)
class Push:
    """One push."""

    kind: str  # ``poke`` (Gaussian falloff around a point) or ``drag`` (grows with height)
    point: tuple[float, float, float]  # where [scene units]
    direction: tuple[float, float, float]  # where to, unit length
    amplitude: float  # largest displacement that it causes, as a fraction of the body's diagonal


@dataclass(frozen=True)
class Fall:
    """One fall, from the undeformed and upright body on."""

    shift: tuple[float, float, float]  # of the body in frame 0 from its rest state [scene units]
    velocity: tuple[float, float, float]  # of its centre of mass in frame 0 [scene units / s]
    spin: tuple[float, float, float]  # angular velocity in frame 0 [radian / s]


def random_motion(
    body: Body, elastic: ElasticBody, kind: str, rng: np.random.Generator, swing: tuple[float, float], frames: int
) -> tuple[Push, Array]:
    """A random push and the motion (frames, N, 3) after it.

    Pushes that turn an element inside out, which no solid does, are drawn again.

    Raises:
        DivergenceError: all pushes that were drawn do, or one does not reach its amplitude.
    """
    for _ in range(DRAWS):
        push = random_push(body, kind, rng, swing)
        motion = pushed_motion(body, elastic, push, frames)
        if body.least_volume(motion) > 0:
            return push, motion
    raise DivergenceError(
        f"{DRAWS} pushes of {swing[0]:g} to {swing[1]:g} diagonals all turned finite elements inside out. Choose a "
        "smaller --swing."
    )


def random_push(body: Body, kind: str, rng: np.random.Generator, swing: tuple[float, float]) -> Push:
    """A push of the upper half of a body, mostly sideways, its amplitude within ``swing`` [diagonals]."""
    height = np.ptp(body.nodes[:, 2])
    upper = np.flatnonzero(body.nodes[:, 2] > body.nodes[:, 2].min() + 0.5 * height)
    point = body.nodes[rng.choice(upper)]
    angle, lift = rng.uniform(0, 2 * np.pi), rng.uniform(-0.5, 0.5) if kind == "poke" else 0.0
    direction = np.array([np.cos(angle), np.sin(angle), lift]) / np.hypot(1.0, lift)
    return Push(kind, tuple(point.tolist()), tuple(direction.tolist()), float(rng.uniform(*swing)))


def push_field(body: Body, push: Push) -> Array:
    """Shape (N, 3) of the initial velocity of a push, zero at held nodes."""
    height = (body.nodes[:, 2] - body.nodes[:, 2].min()) / np.ptp(body.nodes[:, 2])
    weight = height**1.5
    if push.kind == "poke":
        # As wide as a thumb on a cup: narrower pokes put their energy into modes faster than the camera.
        width = 0.28 * body.diagonal
        distance = np.linalg.norm(body.nodes - np.array(push.point), axis=1)
        weight = height * np.exp(-0.5 * (distance / width) ** 2)
    field = weight[:, None] * np.array(push.direction)
    field[body.held] = 0.0
    return field


def pushed_motion(body: Body, elastic: ElasticBody, push: Push, frames: int) -> Array:
    """Motion (frames, N, 3) of a body after a push, scaled to the push's amplitude by trial swings.

    Raises:
        DivergenceError: the body reaches the amplitude at no speed that was tried.
    """
    velocity = push_field(body, push)
    velocity *= TRIAL_SPEED * body.diagonal / np.abs(velocity).max()
    if push.amplitude <= LINEAR:
        return elastic.simulate(velocity * (push.amplitude / _peak(body, elastic, velocity)), frames)
    for exponent in WHOLE * [1.0] + HALF * [0.5]:
        peak = _peak(body, elastic, velocity)
        if abs(peak / push.amplitude - 1) < TOLERANCE:
            return elastic.simulate(velocity, frames)
        velocity *= (push.amplitude / peak) ** exponent
    raise DivergenceError(
        f"a {push.kind} of {push.amplitude:.3f} diagonals is not reached within {WHOLE + HALF} trials; the last "
        f"gave {peak:.3f}. Choose a smaller --swing."
    )


def _peak(body: Body, elastic: ElasticBody, velocity: Array) -> float:
    """Largest displacement within the first swing [diagonals]."""
    swing = elastic.simulate(velocity, FIRST_SWING)
    return float(np.linalg.norm(swing - body.nodes, axis=-1).max() / body.diagonal)


def random_fall(rng: np.random.Generator) -> Fall:
    """A fall that lands within a few frames of the others."""
    shift = rng.uniform(-1, 1, 3) * [ASIDE, ASIDE, HIGHER]
    velocity = rng.uniform(-1, 1, 3) * [SIDEWAYS, SIDEWAYS, UPWARDS]
    spin = rng.uniform(-1, 1, 3) * SPIN
    return Fall(*(tuple(x.round(6).tolist()) for x in (shift, velocity, spin)))


def fall_field(body: Body, fall: Fall) -> Array:
    """Velocity (N, 3) of the nodes in frame 0 [scene units / s]."""
    return np.array(fall.velocity) + np.cross(fall.spin, body.nodes - body.nodes.mean(0))
