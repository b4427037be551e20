"""One body of a corpus from a plan and its number alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from data_prep.common.spread import farthest
from data_prep.random_bodies.lattice import PINS, body_of, pinned, warped
from data_prep.random_bodies.matter import Matter, Modes, modes_of, random_drag, random_matter
from data_prep.random_bodies.motion import FiniteElements, push_velocity, random_push
from data_prep.random_bodies.plan import CELLS, DIAGONALS, KEPT_SWING, LEAST_VOLUME, PERIODS, RATES, Plan
from data_prep.random_bodies.shapes import SHAPES, Rng
from data_prep.synthetic.bodies import Array, Body
from data_prep.synthetic.embedding import CANDIDATES, Embedding, cover_surface
from gausim.core import DivergenceError
from gausim.data.corpus import BodyRecord, PushRecord

MODES = 32
# Element steps per frame that are not paid, of bodies of CELLS; as fast ones of more cells take more.
MOST_COST = 3e5
PUSH_TRIALS, WEAKER, STRONGER = 4, 0.6, 2.0
BODY_TRIALS, KIND_TRIALS = 60, 6  # draws of a body, and those of one kind of shape and pins


class Rejected(Exception):
    """A body or push that is drawn again."""


@dataclass(frozen=True, eq=False)
class Subject:
    """A body that is ready to move."""

    shape: str
    pins: str
    points: Embedding
    matter: Matter
    modes: Modes
    fps: float
    period: float  # of the slowest mode [frames]
    simulator: FiniteElements


def make_body(plan: Plan, number: int) -> tuple[dict[str, Array], BodyRecord]:
    """Tensors and facts of a body; the shard is left empty in them.

    Raises:
        DivergenceError: none of many draws gave motion worth keeping, which no plan within its limits brings about.
    """
    redrawn = 0
    for trial in range(BODY_TRIALS):
        # Shape and pins stay for some trials, or those that are dear to simulate would be rare.
        kinds = np.random.default_rng([plan.seed, number, 1, trial // KIND_TRIALS])
        shape, pins = plan.shapes[int(kinds.integers(len(plan.shapes)))], str(kinds.choice(PINS))
        rng = np.random.default_rng([plan.seed, number, 2, trial])
        try:
            subject = _draw(plan, shape, pins, rng)
            positions, pushes, failed = _sequences(plan, subject, rng)
        except (Rejected, DivergenceError):
            redrawn += 1
            continue
        return _result(plan, number, subject, positions, pushes, redrawn + failed)
    raise DivergenceError(f"body {number}: {BODY_TRIALS} draws gave no motion worth keeping. Choose another --swing.")


def _draw(plan: Plan, shape: str, pins: str, rng: Rng) -> Subject:
    """A body of a kind of shape at rest."""
    body = body_of(SHAPES[shape](rng), int(rng.integers(*plan.cells)))
    held = body and pinned(warped(body, float(np.exp(rng.uniform(*np.log(DIAGONALS)))), rng), pins, rng)
    if held is None:
        raise Rejected
    fps = float(rng.choice(RATES))
    period = float(np.exp(rng.uniform(*np.log(PERIODS))))
    relative = random_matter(held, rng, kinds=plan.materials)
    if relative.kind not in plan.materials:
        raise Rejected
    modes = modes_of(held, relative, MODES)
    faster = 2 * np.pi * fps / period / modes.omega[0]
    drag = relative.drag * random_drag(modes.omega[0] * faster, rng)
    matter = replace(relative, young_modulus=relative.young_modulus * faster**2, drag=drag)
    modes = replace(modes, omega=modes.omega * faster, highest=modes.highest * faster)
    finer = (plan.cells[1] / CELLS[1]) ** (4 / 3)
    if modes.highest / fps * 6 * len(held.cells) > MOST_COST * finer:
        raise Rejected
    points = _kernels(held, int(rng.integers(plan.kernels[0], plan.kernels[1] + 1)), rng)
    simulator = FiniteElements(points, matter, modes, fps=fps)
    return Subject(shape, pins, points, matter, modes, fps, period, simulator)


def _kernels(body: Body, count: int, rng: Rng) -> Embedding:
    """Points on the surface, in half of the bodies some of them inside."""
    inside = int(count * rng.choice([0, rng.uniform(0.1, 0.6)]))
    surface = cover_surface(body, count - inside, rng)[0]
    if not inside:
        return surface
    center = Embedding(body, np.arange(len(body.cells)), np.full((len(body.cells), 3), 0.5))
    volume = np.linalg.det(center.jacobian)
    cell = rng.choice(len(volume), size=CANDIDATES * inside, p=volume / volume.sum())
    within = Embedding(body, cell, rng.random((len(cell), 3)))
    chosen = farthest(within.positions(body.nodes), inside)
    return Embedding(
        body, np.concatenate((surface.cell, cell[chosen])), np.concatenate((surface.local, within.local[chosen]))
    )


def _sequences(plan: Plan, subject: Subject, rng: Rng) -> tuple[Array, list[PushRecord], int]:
    """Positions (S, F, K, 3), their pushes, and how many pushes were drawn in vain."""
    kept, records, failed = list[Array](), list[PushRecord](), 0
    body, masses = subject.points.body, subject.matter.node_masses(subject.points.body)
    offset = max(1, round(subject.period / 4))
    while len(kept) < plan.sequences:
        push = random_push(rng, plan.swing)
        for _ in range(PUSH_TRIALS):
            velocity = push_velocity(body, masses, subject.modes, push, subject.fps, rng)
            skipped = offset if push.start == "release" else 0
            positions, swing, volume = _swing(subject, velocity, plan.frames, skipped)
            if KEPT_SWING[0] <= swing <= KEPT_SWING[1] and volume >= LEAST_VOLUME:
                break
            failed += 1
            push = replace(push, amplitude=push.amplitude * (STRONGER if swing < KEPT_SWING[0] else WEAKER))
        else:
            raise Rejected
        kept.append(positions)
        records.append(PushRecord(push.kind, push.start, push.direction, swing))
    return np.array(kept), records, failed


def _swing(subject: Subject, velocity: Array, frames: int, skipped: int) -> tuple[Array, float, float]:
    """Positions, their largest displacement [diagonals] and the least relative volume; infinite after an explosion."""
    try:
        positions, volume = subject.simulator.simulate(velocity, frames + skipped)
    except DivergenceError:
        return np.zeros(0), np.inf, 0.0
    positions = positions[skipped:]
    rest = subject.points.positions(subject.points.body.nodes)
    swing = np.linalg.norm(positions - rest, axis=-1).max() / subject.points.body.diagonal
    return positions, float(swing), volume


def _result(
    plan: Plan, number: int, subject: Subject, positions: Array, pushes: list[PushRecord], redrawn: int
) -> tuple[dict[str, Array], BodyRecord]:
    points, matter, body = subject.points, subject.matter, subject.points.body
    rest, cell = points.positions(body.nodes), points.cell
    near = cKDTree(rest).query(rest, k=4)[0][:, 1:]
    tensors = {
        "rest": rest.astype(np.float32),
        "pinned": points.held(),
        "scale": (0.5 * near.mean(1)).astype(np.float32),  # as a splat's reconstruction starts
        "stiffness": matter.young_modulus[cell].astype(np.float32),
        "density": matter.density[cell].astype(np.float32),
        "damping": matter.drag[cell].astype(np.float32),
        "displacement": ((positions - rest) / body.diagonal).astype(np.float16),
    }
    record = BodyRecord(
        name=f"{subject.shape}_{number:06d}", shard="", shape=subject.shape, pins=subject.pins, material=matter.kind,
        contrast=matter.contrast, kernels=len(rest), sequences=len(positions),
        frames=plan.frames, fps=subject.fps, diagonal=body.diagonal, poisson_ratio=matter.poisson_ratio,
        period=subject.period, swing=max(push.swing for push in pushes), pushes=tuple(pushes), redrawn=redrawn,
    )  # fmt: skip
    return tensors, record
