"""Up and scale of a world of poses, as people state them: by cameras, by a vector, by distances of marked points."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from data_prep.capture.cameras.sources import Posed
from data_prep.capture.cameras.world import (
    Similarity,
    centers,
    looked_at,
    metres_per_unit,
    triangulate,
    up_of_cameras,
    up_of_plane,
    upright,
)
from data_prep.common.command import Options, option
from gausim.core.errors import ConfigError
from gausim.io.colmap import PointTable

_PICK = re.compile(r"(.+)@(-?[0-9.]+),(-?[0-9.]+)")
# Distances that disagree by more than this were measured or marked wrongly.
_DISAGREEMENT = 0.05


@dataclass(frozen=True)
class WorldOptions(Options):
    """The world that poses are brought to."""

    up: str | None = option(
        None, "turn z up: by the mean up of the 'cameras' (default for found poses), the 'plane' of their centres, a "
        "vector X,Y,Z, or 'keep' (default for poses that are taken over)", metavar="RULE",
    )  # fmt: skip
    distance: tuple[tuple[str, str, str], ...] = option(
        (), "known distance; A and B are ids of points.npz or PHOTO@X,Y+PHOTO@X,Y; repeatable", nargs=3,
        action="append", metavar=("A", "B", "METRES"),
    )  # fmt: skip


def place(
    found: Sequence[Posed], points: PointTable, options: WorldOptions, *, mapped: bool
) -> tuple[Similarity, dict[str, Any]]:
    """The transform from the found world to the wanted one, and what the manifest says of it.

    A world found from photos (``mapped``) has neither up, origin nor scale: it is turned upright, its origin becomes
    the point that the cameras look at, and without known distances the cameras are one unit from it on average. A world
    that is taken over stays as it is unless something is asked for.

    Raises:
        ConfigError: an option is malformed, or distances disagree.
        DataError: up cannot be told from the cameras, or picks do not meet.
    """
    viewmats = np.stack([shot.viewmat for shot in found])
    rule = options.up if options.up is not None else ("cameras" if mapped else "keep")
    kept = rule == "keep"
    move = Similarity(1.0, np.eye(3) if kept else upright(_up(rule, viewmats)), np.zeros(3))
    facts: dict[str, Any] = {"up": "as given" if kept else "z", "up_rule": rule}
    facts["gravity_direction"] = None if kept else [0.0, 0.0, -1.0]
    if mapped:
        middle = looked_at(viewmats)
        move = Similarity(1.0, move.rotation, -move.rotation @ middle)
    if options.distance:
        scale, off = metres_per_unit([_distance(found, points, *entry) for entry in options.distance])
        if off > _DISAGREEMENT:
            raise ConfigError(f"--distance: the distances disagree by {100 * off:.1f} %; check what was marked.")
        facts.update(unit="metres", distances_disagree=off)
    elif mapped:
        scale = 1 / max(float(np.linalg.norm(centers(viewmats) - looked_at(viewmats), axis=1).mean()), 1e-12)
        facts["unit"] = "mean distance of the cameras from what they look at"
    else:
        scale, facts["unit"] = 1.0, "as given"
    move = move.then(Similarity(scale, np.eye(3), np.zeros(3)))
    facts.update(scale=move.scale, rotation=move.rotation.tolist(), shift=move.shift.tolist())
    return move, facts


def _up(rule: str, viewmats: np.ndarray) -> np.ndarray:
    """The unit vector (3,) that is up by a rule."""
    if rule in ("cameras", "plane"):
        return up_of_cameras(viewmats) if rule == "cameras" else up_of_plane(viewmats)
    try:
        direction = np.array([float(word) for word in rule.split(",")])
    except ValueError:
        direction = np.zeros(0)
    length = float(np.linalg.norm(direction))
    if direction.shape != (3,) or not 1e-9 < length < 1e9:
        raise ConfigError(f"--up '{rule}': expected cameras, plane, keep, or three numbers like 0,-1,0.")
    return direction / length


def _distance(found: Sequence[Posed], points: PointTable, first: str, second: str, metres: str) -> tuple[float, float]:
    try:
        true = float(metres)
    except ValueError:
        raise ConfigError(f"--distance {first} {second} {metres}: the last must be a length [m].") from None
    a, b = _marked(found, points, first), _marked(found, points, second)
    return float(np.linalg.norm(a - b)), true


def _marked(found: Sequence[Posed], points: PointTable, text: str) -> np.ndarray:
    """A marked point (3,) in the found world."""
    if text.isdigit():
        index = np.flatnonzero(points.ids == int(text))
        if not len(index):
            raise ConfigError(f"--distance: there is no point {text} among {len(points.ids)}; see ids in points.npz.")
        return points.xyz[index[0]]
    shots = {shot.photo.name: shot for shot in found}
    picks = []
    for part in text.split("+"):
        match = _PICK.fullmatch(part)
        if match is None or match[1] not in shots:
            raise ConfigError(
                f"--distance '{text}': expected a point's id, or PHOTO@X,Y+PHOTO@X,Y with photos that have poses "
                f"(e.g. {next(iter(shots))}@120,80), got '{part}'."
            )
        shot = shots[match[1]]
        try:
            pixel = float(match[2]), float(match[3])
        except ValueError:
            raise ConfigError(f"--distance '{part}': the pixel must be two numbers.") from None
        picks.append((shot.camera, shot.viewmat, pixel))
    return triangulate(picks, f"--distance '{text}'")
