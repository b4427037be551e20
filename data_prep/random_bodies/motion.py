"""Motion of a body: random pushes as sums of its slow modes, and two simulators of what follows from one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import torch
from scipy.spatial import cKDTree

from data_prep.random_bodies.matter import Matter, Modes
from data_prep.random_bodies.shapes import Rng
from data_prep.synthetic.bodies import Array, Body
from data_prep.synthetic.elastic import ElasticBody
from data_prep.synthetic.embedding import Embedding
from data_prep.synthetic.plan import Material
from gausim.baselines.mpm import Grid, MPMSolver, Particles, ParticleState, TimeStep
from gausim.baselines.mpm import Material as PointMaterial
from gausim.core import DivergenceError
from gausim.data.corpus import Kind, Start

KINDS: tuple[Kind, ...] = get_args(Kind)
RELEASED = 0.35  # of the sequences start at the first turn of the motion
SMALLER = 1.5  # exponent that makes small pushes more frequent than large ones
WIDTH = 0.28  # of a poke [diagonals]
# Slowest modes that a push may excite: those slower than this [frames], but never fewer than LEAST_MODES.
FASTEST_PERIOD, LEAST_MODES = 2.5, 3
# Of the step 2 / omega at which the fastest mode at rest would explode: bodies stiffen as they stretch.
STEP_FRACTION = 0.65
MARGIN = 0.6  # empty domain around the material points [diagonals]
TRACER = 1e-4  # volume of a kernel that is carried along, in those of the points


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

    name = "mujoco"

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


class MaterialPoints:
    """MLS-MPM of a fixed corotated material: eight points per cell; the K points are carried along."""

    name = "material_points"

    def __init__(self, points: Embedding, matter: Matter, *, fps: float) -> None:
        body, self._points = points.body, points
        quarters = (np.array([[a, b, c] for a in (1, 3) for b in (1, 3) for c in (1, 3)]) / 4.0)[None]
        count = len(body.cells)
        inner = Embedding(body, np.repeat(np.arange(count), 8), np.tile(quarters, (count, 1, 1)).reshape(-1, 3))
        cell = np.concatenate((inner.cell, points.cell))
        self._all = Embedding(body, cell, np.concatenate((inner.local, points.local)))
        volume = np.abs(np.linalg.det(inner.jacobian)) / 8
        volumes = torch.from_numpy(np.concatenate((volume, np.full(len(points.cell), TRACER * volume.mean())))).float()
        x = self._all.positions(body.nodes)
        edge = float(np.cbrt(8 * volume.mean()))
        self._shift = MARGIN * body.diagonal - x.min(0)
        cells = int(np.ceil((np.ptp(x, axis=0).max() + 2 * MARGIN * body.diagonal) / edge))
        self._rest = torch.from_numpy(x + self._shift).float()
        self._grid = Grid(cells, cells * edge, damping=float(matter.drag.mean()))
        held = torch.from_numpy(self._all.held())
        particles = Particles.create(self._rest, grid=self._grid, density=1.0, volume=volumes, pinned=held)
        self._particles = replace(particles, mass=volumes * torch.from_numpy(matter.density[cell]).float())
        self._material = PointMaterial(poisson_ratio=matter.poisson_ratio)
        self.young_modulus = torch.from_numpy(matter.young_modulus[cell]).float()
        self._fps = fps

    def simulate(self, velocity: Array, frames: int) -> tuple[Array, float]:
        """As :meth:`FiniteElements.simulate`, or the motion left the domain."""
        x, least = self._run(velocity, frames, 1 / self._fps)
        return x[:, -len(self._points.cell) :] - self._shift, least

    def cost(self) -> float:
        """Steps of all points in a frame."""
        solver = MPMSolver(self._particles, self._material, self._grid, TimeStep(1 / self._fps))
        return float(solver.substeps(self.young_modulus) * len(self._rest))

    def _run(self, velocity: Array, frames: int, frame_time: float) -> tuple[Array, float]:
        solver = MPMSolver(self._particles, self._material, self._grid, TimeStep(frame_time))
        state = ParticleState.at_rest(self._rest, torch.from_numpy(self._all.positions(velocity)).float())
        found, least = [self._rest.double().numpy()], 1.0
        with torch.inference_mode():
            for frame in range(1, frames):
                state = solver.advance(state, frame - 1, young_modulus=self.young_modulus)
                found.append(state.positions.double().numpy())
                least = min(least, float(torch.linalg.det(state.deformation_gradients).min()))
        return np.array(found), least

    def period_of(self, shape: Array, expected: float, size: float) -> float:
        """Period [s] of a small swing along a mode's shape (N, 3): four times the time to its first turn.

        Raises:
            DivergenceError: it does not turn within a period.
        """
        samples, along = 20, self._all.positions(shape)
        velocity = shape * (size / np.abs(shape).max() * 2 * np.pi / expected)
        x, _ = self._run(velocity, samples, expected / samples)
        weight = self._particles.mass.numpy()[:, None]
        amount = ((x - x[0]) * along * weight).sum((1, 2))
        turn = int(np.argmax(amount[:-1] > amount[1:]))
        if turn == 0:
            raise DivergenceError("the slowest mode of the material points does not turn within its period.")
        low, mid, high = amount[turn - 1 : turn + 2]
        return 4 * (turn + 0.5 * (low - high) / (low - 2 * mid + high)) * expected / samples


Simulator = FiniteElements | MaterialPoints
