"""The world that poses live in: similarity transforms, and up and scale as people state them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from data_prep.capture.cameras.lenses import project, rays_of
from data_prep.capture.cameras.sources import Posed
from data_prep.common.command import Options, option
from gausim.core.errors import ConfigError, DataError
from gausim.io.colmap import ColmapCamera, PointTable

# A marked point must lie this near to the picks when it is seen by their cameras [pixels of a 1000-pixel photo].
_PICK_TOLERANCE = 8.0
# Centres on a line have no plane: ratio of the second to the first extent below which there is none.
_FLAT = 0.05
_PICK = re.compile(r"(.+)@(-?[0-9.]+),(-?[0-9.]+)")
# Distances that disagree by more than this were measured or marked wrongly.
_DISAGREEMENT = 0.05


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
        None, "turn z up: by the mean up of the 'cameras' (default for found poses), the 'plane' of their centres, a "
        "vector X,Y,Z, or 'keep' (default for poses that are taken over)", metavar="RULE",
    )  # fmt: skip
    distance: tuple[tuple[str, str, str], ...] = option(
        (), "known distance; A and B are ids of points.npz or PHOTO@X,Y+PHOTO@X,Y; repeatable", nargs=3,
        action="append", metavar=("A", "B", "METRES"),
    )  # fmt: skip


def centers(viewmats: np.ndarray) -> np.ndarray:
    """(n, 3) camera centres of world-to-camera matrices (n, 4, 4)."""
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])


def compare(viewmats: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Distance of poses (n, 4, 4) from reference poses of the same images, after similarity alignment of their centres.

    Distances of the centres are per cent of the largest distance between two of the reference's; angles are in degrees.
    The similarity brings the centres nearest to each other in the mean square (Umeyama 1991).

    Raises:
        DataError: all centres lie on one line, as fewer than three do.
    """
    mine, truth = centers(viewmats), centers(reference)
    a, b = mine - mine.mean(0), truth - truth.mean(0)
    u, spread, vt = np.linalg.svd(b.T @ a / len(a))
    if spread[1] <= 1e-12 * max(spread[0], 1e-300):
        raise DataError("the points in common lie on one line; two worlds cannot be aligned by them.")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u * sign @ vt
    scale = float((spread * sign).sum() / (a * a).sum(1).mean())
    move = Similarity(scale, rotation, truth.mean(0) - scale * rotation @ mine.mean(0))
    size = float(np.linalg.norm(truth[:, None] - truth[None], axis=-1).max())
    distance = np.linalg.norm(move.points(mine) - truth, axis=1) / size * 100
    relative = np.stack([move.viewmat(v)[:3, :3] @ r[:3, :3].T for v, r in zip(viewmats, reference, strict=True)])
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    angle = np.degrees(np.arccos(cosine.clip(-1, 1)))
    return {
        "center_error_mean_percent": float(distance.mean()),
        "center_error_max_percent": float(distance.max()),
        "rotation_error_mean_degree": float(angle.mean()),
        "rotation_error_max_degree": float(angle.max()),
    }


def nearest_to_lines(points: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """The point (3,) nearest, in the mean square, to lines through points (n, 3) along unit directions (n, 3).

    None where the lines are parallel.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    total = across.sum(0)
    if np.linalg.cond(total) > 1e6:
        return None
    return np.asarray(np.linalg.solve(total, np.einsum("nij,nj->i", across, points)))


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
    rotation, middle = np.eye(3), _looked_at(viewmats)
    if not kept:  # the smallest rotation that turns up to z
        rotation = Rotation.align_vectors([[0.0, 0.0, 1.0]], [_up(rule, viewmats)])[0].as_matrix()
    facts: dict[str, Any] = {"up": "as given" if kept else "z", "up_rule": rule}
    facts["gravity_direction"] = None if kept else [0.0, 0.0, -1.0]
    if options.distance:
        scale, off = _metres_per_unit(found, points, options.distance)
        facts.update(unit="metres", distances_disagree=off)
    elif mapped:
        scale = 1 / max(float(np.linalg.norm(centers(viewmats) - middle, axis=1).mean()), 1e-12)
        facts["unit"] = "mean distance of the cameras from what they look at"
    else:
        scale, facts["unit"] = 1.0, "as given"
    move = Similarity(scale, rotation, scale * (-rotation @ middle) if mapped else np.zeros(3))
    facts.update(scale=move.scale, rotation=move.rotation.tolist(), shift=move.shift.tolist())
    return move, facts


def _looked_at(viewmats: np.ndarray) -> np.ndarray:
    """The point (3,) nearest to all optical axes of cameras (n, 4, 4); their middle where the axes are parallel."""
    point = nearest_to_lines(centers(viewmats), viewmats[:, 2, :3])
    return centers(viewmats).mean(0) if point is None else point


def _up(rule: str, viewmats: np.ndarray) -> np.ndarray:
    """The unit vector (3,) that is up by a rule, for cameras (n, 4, 4)."""
    # The mean of the directions that are up in the images: people hold cameras level.
    level = -viewmats[:, 1, :3].mean(0)
    if rule == "cameras":
        length = float(np.linalg.norm(level))
        if length < 0.1:
            raise DataError("the cameras have no common up: give it with --up plane or --up X,Y,Z.")
        return level / length
    if rule == "plane":
        x = centers(viewmats)
        _, extent, axes = np.linalg.svd(x - x.mean(0), full_matrices=False)
        if len(x) < 3 or extent[1] < _FLAT * extent[0]:
            raise DataError("the cameras stand in a line, which has no plane: give up with --up cameras or --up X,Y,Z.")
        side = float(axes[2] @ level)
        if abs(side) < 0.1:
            raise DataError("the cameras' plane stands upright: give up with --up cameras or --up X,Y,Z.")
        return axes[2] * np.sign(side)
    try:
        direction = np.array([float(word) for word in rule.split(",")])
    except ValueError:
        direction = np.zeros(0)
    length = float(np.linalg.norm(direction))
    if direction.shape != (3,) or not 1e-9 < length < 1e9:
        raise ConfigError(f"--up '{rule}': expected cameras, plane, keep, or three numbers like 0,-1,0.")
    return direction / length


def _metres_per_unit(
    found: Sequence[Posed], points: PointTable, marked: Sequence[tuple[str, str, str]]
) -> tuple[float, float]:
    """Scale of the world by distances of marked points, and the largest relative disagreement with it."""
    ratios = []
    for first, second, metres in marked:
        try:
            true = float(metres)
        except ValueError:
            raise ConfigError(f"--distance {first} {second} {metres}: the last must be a length [m].") from None
        length = float(np.linalg.norm(_marked(found, points, first) - _marked(found, points, second)))
        if not (0 < length < np.inf and 0 < true < np.inf):
            raise ConfigError("--distance: expected two different points and a length of more than 0 m.")
        ratios.append(true / length)
    logs = np.log(ratios)
    scale, off = float(np.exp(logs.mean())), float(np.abs(np.expm1(logs - logs.mean())).max())
    if off > _DISAGREEMENT:
        raise ConfigError(f"--distance: the distances disagree by {100 * off:.1f} %; check what was marked.")
    return scale, off


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


def triangulate(picks: Sequence[tuple[ColmapCamera, np.ndarray, tuple[float, float]]], what: str) -> np.ndarray:
    """The point (3,) that was picked in several photos: for each its camera, viewmat (4, 4) and pixel.

    Raises:
        DataError: fewer than two photos, rays nearly parallel, or a point that is not where it was picked.
    """
    if len(picks) < 2:
        raise DataError(f"{what}: expected picks in at least 2 photos, got {len(picks)}.")
    rays = np.stack([rays_of(camera, np.array([pixel]))[0] @ viewmat[:3, :3] for camera, viewmat, pixel in picks])
    point = nearest_to_lines(centers(np.stack([viewmat for _, viewmat, _ in picks])), rays)
    if point is None:
        raise DataError(f"{what}: the photos see it from nearly the same direction; pick it in others.")
    for camera, viewmat, pixel in picks:
        missed = float(np.linalg.norm(project(camera, viewmat, point[None])[0] - pixel))
        if not missed <= _PICK_TOLERANCE * max(camera.width, camera.height) / 1000:
            raise DataError(
                f"{what}: the rays of the picks pass each other, by {missed:.1f} pixels at {pixel}. Pick the same "
                "point in all photos, in pixels of the original photos."
            )
    return point
