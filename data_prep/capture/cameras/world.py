"""The world that poses live in: similarity transforms, and up and scale as people state them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from data_prep.capture.cameras.sources import Posed
from data_prep.common.command import Options, option
from gausim.core.errors import ConfigError, DataError


@dataclass(frozen=True, eq=False)
class Similarity:
    """Maps x to ``scale * rotation @ x + shift``; rotation (3, 3), shift (3,), float64."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) in the new world."""
        return self.scale * points @ self.rotation.T + self.shift

    def viewmat(self, viewmat: np.ndarray) -> np.ndarray:
        """A world-to-camera matrix (4, 4) for the new world; camera coordinates are scaled, so images stay the same."""
        moved = np.eye(4)
        moved[:3, :3] = viewmat[:3, :3] @ self.rotation.T
        moved[:3, 3] = self.scale * viewmat[:3, 3] - moved[:3, :3] @ self.shift
        return moved


@dataclass(frozen=True)
class WorldOptions(Options):
    """The world that poses are brought to."""

    up: str | None = option(
        None, "turn z up: by the mean up of the 'cameras' (default for found poses), a vector X,Y,Z, or "
        "'keep' (default for poses that are taken over)", metavar="RULE",
    )  # fmt: skip
    scale: float | None = option(
        None, "scale the world by this factor, such as metres by a length that you know in it "
        "(default for found poses: the cameras' mean distance from what they look at becomes 1)", least=1e-9, most=1e9,
    )  # fmt: skip


def centers(viewmats: np.ndarray) -> np.ndarray:
    """(n, 3) camera centres of world-to-camera matrices (n, 4, 4)."""
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])


def nearest_to_lines(points: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """The point (3,) nearest, in the mean square, to lines through points (n, 3) along unit directions (n, 3).

    None where the lines are parallel.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    total = across.sum(0)
    if np.linalg.cond(total) > 1e6:
        return None
    return np.asarray(np.linalg.solve(total, np.einsum("nij,nj->i", across, points)))


def place(found: Sequence[Posed], options: WorldOptions, *, mapped: bool) -> tuple[Similarity, dict[str, Any]]:
    """The transform from the found world to the wanted one, and what the manifest says of it.

    A world found from photos (``mapped``) has neither up, origin nor scale: it is turned upright, its origin becomes
    the point that the cameras look at, and without a scale the cameras are one unit from it on average. A world
    that is taken over stays as it is unless something is asked for.
    """
    viewmats = np.stack([shot.viewmat for shot in found])
    rule = options.up if options.up is not None else ("cameras" if mapped else "keep")
    kept = rule == "keep"
    eyes = centers(viewmats)
    rotation, middle = np.eye(3), nearest_to_lines(eyes, viewmats[:, 2, :3])
    middle = eyes.mean(0) if middle is None else middle
    if not kept:  # the smallest rotation that turns up to z
        rotation = Rotation.align_vectors([[0.0, 0.0, 1.0]], [_up(rule, viewmats)])[0].as_matrix()
    facts: dict[str, Any] = {"up": "as given" if kept else "z", "up_rule": rule}
    facts["gravity_direction"] = None if kept else [0.0, 0.0, -1.0]
    if options.scale is not None or not mapped:
        scale, facts["unit"] = options.scale or 1.0, "as given"
    else:
        scale = 1 / max(float(np.linalg.norm(eyes - middle, axis=1).mean()), 1e-12)
        facts["unit"] = "mean distance of the cameras from what they look at"
    move = Similarity(scale, rotation, scale * (-rotation @ middle) if mapped else np.zeros(3))
    facts.update(scale=move.scale, rotation=move.rotation.tolist(), shift=move.shift.tolist())
    return move, facts


def _up(rule: str, viewmats: np.ndarray) -> np.ndarray:
    """The unit vector (3,) that is up by a rule, for cameras (n, 4, 4)."""
    # The mean of the directions that are up in the images: people hold cameras level.
    level = -viewmats[:, 1, :3].mean(0)
    if rule == "cameras":
        length = float(np.linalg.norm(level))
        if length < 0.1:
            raise DataError("the cameras have no common up: give it with --up X,Y,Z.")
        return level / length
    try:
        direction = np.array([float(word) for word in rule.split(",")])
    except ValueError:
        direction = np.zeros(0)
    length = float(np.linalg.norm(direction))
    if direction.shape != (3,) or not 1e-9 < length < 1e9:
        raise ConfigError(f"--up '{rule}': expected cameras, keep, or three numbers like 0,-1,0.")
    return direction / length
