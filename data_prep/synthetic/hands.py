"""Paths of two hands that hold a bar at its ends: smooth random motions of several kinds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from data_prep.synthetic.bodies import Array, Body

# Amplitudes of the six motions of the two hands, of which a kind weights some [scene units, radian].
APART, ASIDE, TURN, TWIST, CIRCLE = 0.13, 0.3, 0.45, 0.9, 0.26
MINOR = 0.3  # weight of the motions that are not the kind's
KINDS = {
    # kind: weights of apart, aside, turn, twist, circle
    "stretch": (1.0, MINOR, MINOR, 0.0, 0.0),
    "bend": (MINOR, MINOR, 1.0, 0.0, 0.0),
    "swing": (MINOR, 1.0, MINOR, 0.0, 0.0),
    # Never trained: one hand goes round while the other stays, or the hands wring the bar.
    "crank": (0.0, 0.0, 0.0, 0.0, 1.0),
    "twist": (MINOR, 0.0, 0.0, 1.0, 0.0),
}
SLOW, FAST = 0.35, 1.1  # lowest and highest frequency of a motion [Hz]
BEGIN = 0.5  # hands reach their full amplitude after this time [s]


@dataclass(frozen=True)
class HandPath:
    """A random path: sums of two sinusoids per motion, which begin at rest."""

    kind: str
    weights: tuple[float, ...]  # of the five motions
    frequencies: tuple[tuple[float, float], ...]  # of each motion [Hz]
    phases: tuple[tuple[float, float], ...]  # [radian]
    direction: float  # of what goes sideways, around the bar [radian]
    hand: int  # the one that a crank moves


def random_path(kind: str, rng: np.random.Generator) -> HandPath:
    """A path of a kind; its speed varies, because two frequencies beat."""
    slow = rng.uniform(SLOW, FAST, (5, 1))
    frequencies = np.concatenate((slow, np.minimum(slow * rng.uniform(1.3, 1.9, (5, 1)), FAST)), axis=1)
    phases = rng.uniform(0, 2 * np.pi, (5, 2))
    direction, hand = round(float(rng.uniform(0, 2 * np.pi)), 6), int(rng.integers(2))
    return HandPath(kind, KINDS[kind], _pairs(frequencies), _pairs(phases), direction, hand)


def _pairs(values: Array) -> tuple[tuple[float, float], ...]:
    return tuple((a, b) for a, b in values.round(6).tolist())


def held_path(body: Body, path: HandPath, times: Array) -> Array:
    """Positions (T, H, 3) of the held nodes at ``times`` [s]; they move rigidly with their hand."""
    nodes = body.nodes[body.held]
    hand = nodes[:, 0] > 0
    result = np.empty((len(times), *nodes.shape))
    for number in (0, 1):
        own = nodes[hand == number]
        center = own.mean(0)
        shift, turn = _motion(path, number, times)
        rotation = Rotation.from_rotvec(turn).as_matrix()
        result[:, hand == number] = center + shift[:, None] + (own - center) @ rotation.mT
    return result


def _motion(path: HandPath, hand: int, times: Array) -> tuple[Array, Array]:
    """Shift (T, 3) [scene units] and rotation vector (T, 3) [radian] of a hand, both 0 with their rates at time 0."""
    rise = np.clip(times / BEGIN, 0, 1)
    rise = rise**3 * (10 - 15 * rise + 6 * rise**2)
    angle = 2 * np.pi * np.array(path.frequencies)[:, None] * times[:, None] + np.array(path.phases)[:, None]
    apart, aside, turn, twist, circle = rise * (np.sin(angle) @ [0.7, 0.5]) * np.array(path.weights)[:, None]
    around = rise * (np.cos(angle[4]) @ [0.7, 0.5]) * path.weights[4]
    side = 2 * hand - 1
    # A stretched bar gets longer more than it is pushed together: it would buckle.
    out = side * (APART * apart + 0.7 * APART * rise * path.weights[0])
    sideways = np.array([np.cos(path.direction), np.sin(path.direction)])
    y, z = ASIDE * aside * sideways[:, None] + (hand == path.hand) * CIRCLE * np.stack((circle, around))
    bend = side * TURN * turn * np.array([-sideways[1], sideways[0]])[:, None]
    return np.stack((out, y, z), 1), np.stack((side * TWIST * twist, *bend), 1)


def grip(rest: Array, pinned: NDArray[np.bool_]) -> float:
    """A distance from the pinned ones of K kernels (K, 3) within which no kernel is free [scene units]."""
    return 0.9 * float(cKDTree(rest[pinned]).query(rest[~pinned])[0].min())
