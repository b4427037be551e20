"""The world that poses live in: similarity transforms, which way is up, how long a metre is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from data_prep.capture.cameras.lenses import project, rays_of
from gausim.core.errors import ConfigError, DataError
from gausim.io.colmap import ColmapCamera

# A marked point must lie this near to the picks when it is seen by their cameras [pixels of a 1000-pixel photo].
_PICK_TOLERANCE = 8.0
# Centres on a line have no plane: ratio of the second to the first extent below which there is none.
_FLAT = 0.05


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

    def then(self, other: Similarity) -> Similarity:
        """This one followed by the other."""
        return Similarity(other.scale * self.scale, other.rotation @ self.rotation, other.points(self.shift[None])[0])


def centers(viewmats: np.ndarray) -> np.ndarray:
    """(n, 3) camera centres of world-to-camera matrices (n, 4, 4)."""
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])


def fit_similarity(source: np.ndarray, target: np.ndarray) -> Similarity:
    """The similarity that brings (n, 3) points nearest to their partners in the mean square (Umeyama 1991).

    Raises:
        DataError: fewer than three points, or all of them on one line.
    """
    if len(source) < 3:
        raise DataError(f"{len(source)} points in common: expected at least 3 to align two worlds.")
    middle, goal = source.mean(0), target.mean(0)
    a, b = source - middle, target - goal
    u, size, vt = np.linalg.svd(b.T @ a / len(a))
    if size[1] <= 1e-12 * max(size[0], 1e-300):
        raise DataError("the points in common lie on one line; two worlds cannot be aligned by them.")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u * sign @ vt
    scale = float((size * sign).sum() / (a * a).sum(1).mean())
    return Similarity(scale, rotation, goal - scale * rotation @ middle)


def compare(viewmats: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Distance of poses (n, 4, 4) from reference poses of the same images, after similarity alignment of their centres.

    Distances of the centres are per cent of the largest distance between two of the reference's; angles are in degrees.
    """
    mine, truth = centers(viewmats), centers(reference)
    move = fit_similarity(mine, truth)
    size = float(np.linalg.norm(truth[:, None] - truth[None], axis=-1).max())
    distance = np.linalg.norm(move.points(mine) - truth, axis=1) / size * 100
    relative = np.stack([move.viewmat(v)[:3, :3] @ r[:3, :3].T for v, r in zip(viewmats, reference, strict=True)])
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    angle = np.degrees(np.arccos(cosine.clip(-1, 1)))
    return {
        "images": len(mine),
        "center_error_mean_percent": float(distance.mean()),
        "center_error_max_percent": float(distance.max()),
        "rotation_error_mean_degree": float(angle.mean()),
        "rotation_error_max_degree": float(angle.max()),
    }


def up_of_cameras(viewmats: np.ndarray) -> np.ndarray:
    """Unit mean (3,) of the directions that are up in the images (n, 4, 4): people hold cameras level.

    Raises:
        DataError: they cancel out.
    """
    up = -viewmats[:, 1, :3].mean(0)
    length = float(np.linalg.norm(up))
    if length < 0.1:
        raise DataError("the cameras have no common up: give it with --up plane or --up X,Y,Z.")
    return up / length


def up_of_plane(viewmats: np.ndarray) -> np.ndarray:
    """Unit normal (3,) of the plane that the camera centres (n, 4, 4) lie nearest to, on the side of the images' up.

    Raises:
        DataError: the centres lie on a line, or the normal is level with the images.
    """
    x = centers(viewmats)
    _, extent, axes = np.linalg.svd(x - x.mean(0), full_matrices=False)
    if len(x) < 3 or extent[1] < _FLAT * extent[0]:
        raise DataError("the cameras stand in a line, which has no plane: give up with --up cameras or --up X,Y,Z.")
    side = float(axes[2] @ -viewmats[:, 1, :3].mean(0))
    if abs(side) < 0.1:
        raise DataError("the cameras' plane stands upright: give up with --up cameras or --up X,Y,Z.")
    return axes[2] * np.sign(side)


def upright(up: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that turns a unit vector (3,) to z."""
    rotation: np.ndarray = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()
    return rotation


def nearest_to_lines(points: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """The point (3,) nearest, in the mean square, to lines through points (n, 3) along unit directions (n, 3).

    None where the lines are parallel.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    total = across.sum(0)
    if np.linalg.cond(total) > 1e6:
        return None
    return np.asarray(np.linalg.solve(total, np.einsum("nij,nj->i", across, points)))


def looked_at(viewmats: np.ndarray) -> np.ndarray:
    """The point (3,) nearest to all optical axes of cameras (n, 4, 4); their middle where the axes are parallel."""
    point = nearest_to_lines(centers(viewmats), viewmats[:, 2, :3])
    return centers(viewmats).mean(0) if point is None else point


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


def metres_per_unit(found: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Scale of the world from distances (found [units], true [m]), and the largest relative disagreement with it.

    Raises:
        ConfigError: a distance is not positive.
    """
    if any(not (0 < a < np.inf and 0 < b < np.inf) for a, b in found):
        raise ConfigError("--distance: expected two different points and a length of more than 0 m.")
    logs = np.log([b / a for a, b in found])
    scale = float(np.exp(logs.mean()))
    return scale, float(np.abs(np.expm1(logs - logs.mean())).max())
