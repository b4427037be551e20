"""Registration of two worlds by silhouettes: stills of an object at rest, and a few cameras that see it elsewhere.

The visual hull of the stills is turned, scaled and moved (x' = s R x + t) until its silhouettes cover the masks in the
other cameras. Rotations all over SO(3) are tried; for each, scale and place follow from the sizes and middles of the
silhouettes. The best are refined by Nelder and Mead's method, and of those that cover the masks alike the one whose
colours agree is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from data_prep.capture.cameras.world import Similarity, centers, nearest_to_lines
from data_prep.common.progress import Tick
from data_prep.public.pictures import HALF, resized
from data_prep.public.scene import Picture, View
from gausim.core.errors import DataError

# Voxels along the hull's longest side, and cells along the longer side of a mask's bounding box: a voxel is smaller.
VOXELS, CELLS = 64, 40
# Longest side of the stills' masks that the hull is carved from [pixels], and the part of them that may miss something.
CARVED, MISSING = 256, 0.05
# Points of the hull to try rotations with, and how many of these are refined.
TRIED_POINTS, REFINED = 1500, 12
PLACING_ROUNDS, REFINEMENT_STEPS = 4, 260
# How far neighbours of a fit are looked for at first and at last [radian, or of the body's size].
COARSE, FINE = 0.15, 0.04
# Fits whose overlap differs by less than this are decided by colour; turns further apart are other solutions [degree].
CLOSE, APART = 0.03, 20.0
# Correlations of colours that differ by less decide nothing.
UNDECIDED = 0.1


class _Fit(NamedTuple):
    """A place that the body may have."""

    overlap: float
    rotation: np.ndarray
    scale: float
    shift: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the body in the frames' world."""
        return points @ self.rotation.T * self.scale + self.shift


@dataclass(frozen=True, eq=False)
class Registration:
    """A similarity, with how well it fits."""

    move: Similarity  # from the stills' world to the frames'
    overlap: float  # mean intersection over union of the silhouettes
    by_view: dict[str, float]  # the same by camera
    colour: float  # correlation of colours, -1 to 1
    second: float  # the same of the best other turn that covers the masks as well, -1 where there is none

    @property
    def ambiguous(self) -> bool:
        """Whether another turn covers the masks as well and has colours that agree nearly as well."""
        return self.second > self.colour - UNDECIDED

    def told(self) -> dict[str, Any]:
        """As plain data."""
        move = {"scale": self.move.scale, "rotation": self.move.rotation.tolist(), "shift": self.move.shift.tolist()}
        return move | {name: value for name, value in vars(self).items() if name != "move"}


@dataclass(frozen=True, eq=False)
class _Window:
    """A camera's mask on a grid of cells around it."""

    view: View
    corner: np.ndarray  # (2,) first pixel of the grid
    cell: float  # [pixels]
    filled: np.ndarray  # (rows, columns) float32, blurred
    middle: np.ndarray  # (2,) middle of the mask's box [pixels]
    extent: float  # diagonal of the mask's box [pixels]
    rgb: np.ndarray  # (H, W, 3) uint8


@dataclass(frozen=True, eq=False)
class _Body:
    """Surface of the hull, its middle at the origin."""

    points: np.ndarray  # (N, 3)
    normals: np.ndarray  # (N, 3) outwards
    colors: np.ndarray  # (N, 3) by the stills that face it; NaN where none does
    middle: np.ndarray  # (3,) in the stills' world
    size: float  # diagonal


def register(
    stills: Sequence[tuple[View, Picture]], frames: Sequence[tuple[View, Picture]], *, turns: int, tick: Tick
) -> Registration:
    """The similarity from the stills' world to that of the frames, which show the object in one moment.

    Args:
        stills: posed pictures around the object.
        frames: one picture of each camera of the other world.
        turns: rotations to begin from.
        tick: told of the progress.

    Raises:
        DataError: masks are empty, or the stills have no common body.
    """
    body, windows = _body(stills, tick), [_window(view, picture) for view, picture in frames]
    chosen = body.points[:: max(1, len(body.points) // TRIED_POINTS)]
    tried, found = list[_Fit](), list[_Fit]()
    for i, rotation in enumerate(_turns(turns), 1):
        tried.append(_placed(chosen, rotation, windows))
        tick("turns", i, turns)
    for i, fit in enumerate(_spread(tried), 1):
        found.append(_refined(body, windows, fit, COARSE))
        tick("refining", i, REFINED)
    top = max(fit.overlap for fit in found)
    for step in (COARSE, FINE):  # begun again, as the method's simplex may have collapsed early
        found = [_refined(body, windows, fit, step) for fit in found if fit.overlap > top - 2 * CLOSE]
    return _best(body, windows, found)


def _spread(tried: list[_Fit]) -> list[_Fit]:
    """The best turns, best first, of which none is close to a better one."""
    kept: list[_Fit] = []
    for fit in sorted(tried, key=lambda fit: -fit.overlap):
        if len(kept) < REFINED and all(_angle(fit, other) > APART / 2 for other in kept):
            kept.append(fit)
    return kept


def _turns(count: int) -> np.ndarray:
    """(count, 3, 3) rotations spread evenly (Alexa, Super-Fibonacci Spirals, CVPR 2022)."""
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    a, b = 2 * math.pi * s / math.sqrt(2), 2 * math.pi * s / 1.533751168755204288118041
    return Rotation.from_quat(
        np.stack((inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)), -1)
    ).as_matrix()


def _body(stills: Sequence[tuple[View, Picture]], tick: Tick) -> _Body:
    import torch

    from gausim.ops.visual_hull import carve

    pictures, views = [], [view.smaller(CARVED) for view, _ in stills]
    for i, (view, (_, picture)) in enumerate(zip(views, stills, strict=True), 1):
        pictures.append(resized(picture.read(), view.size))
        tick("hull", i, len(stills))
    if len({pixels.shape for pixels in pictures}) > 1:
        raise DataError(
            f"{stills[0][1].files[0].parent}: stills differ in size; the masks of one object need one size."
        )
    viewmats, ks = np.stack([view.viewmat for view in views]), np.stack([view.k for view in views])
    masks = torch.from_numpy(np.stack(pictures)[..., 3] > HALF)
    hull = carve(masks, torch.from_numpy(viewmats).float(), torch.from_numpy(ks).float(), VOXELS, missing=MISSING)
    if hull is None or not hull.occupied.any():
        raise DataError(
            f"{stills[0][1].files[-1].parent}: the stills' masks have no common body. Check them against the poses."
        )
    points, normals = (part.double().numpy() for part in hull.surface())
    middle = (points.max(0) + points.min(0)) / 2
    colors = _colors(points, normals, viewmats, ks, pictures)
    return _Body(points - middle, normals, colors, middle, float(np.linalg.norm(np.ptp(points, axis=0))))


def _colors(
    points: np.ndarray, normals: np.ndarray, viewmats: np.ndarray, ks: np.ndarray, pictures: Sequence[np.ndarray]
) -> np.ndarray:
    """(N, 3) mean colours of points in the pictures that they face; NaN where there is none."""
    total, count = np.zeros_like(points), np.zeros(len(points))
    for viewmat, k, pixels in zip(viewmats, ks, pictures, strict=True):
        colors, seen = _sampled(points, normals, viewmat, k, pixels)
        total[seen] += colors[seen]
        count += seen
    return np.asarray(np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], np.nan))


def _sampled(
    points: np.ndarray, normals: np.ndarray, viewmat: np.ndarray, k: np.ndarray, pixels: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (N, 3) at the points' pixels, and which points face the camera and lie in the picture."""
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    facing = ((normals @ viewmat[:3, :3].T) * local).sum(-1) < -0.3 * np.linalg.norm(local, axis=-1)
    x, y = _pixels(local, k).astype(np.int64).T
    inside = (x >= 0) & (x < pixels.shape[1]) & (y >= 0) & (y < pixels.shape[0])
    colors = pixels[y.clip(0, pixels.shape[0] - 1), x.clip(0, pixels.shape[1] - 1), :3].astype(np.float64)
    return colors, facing & inside


def _pixels(local: np.ndarray, k: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of points in camera axes."""
    uv = (local / np.maximum(local[:, 2:], 1e-6)) @ k.T
    return np.asarray(uv[:, :2].clip(-1e7, 1e7))


def _window(view: View, picture: Picture) -> _Window:
    pixels = picture.read()
    inside = pixels[..., 3] > HALF
    if not inside.any():
        raise DataError(f"{picture.files[-1]}: the mask is empty; expected the object in it. Check the mask.")
    rows, columns = np.nonzero(inside.any(1))[0], np.nonzero(inside.any(0))[0]
    low, high = np.array([columns[0], rows[0]], float), np.array([columns[-1] + 1, rows[-1] + 1], float)
    middle, side = (low + high) / 2, float((high - low).max())
    cell = side / CELLS
    # Three times as wide as the mask: silhouettes that lie beside it count against the fit.
    corner, count = middle - 1.5 * side, 3 * CELLS
    grid = np.array([[1 / cell, 0, -corner[0] / cell], [0, 1 / cell, -corner[1] / cell]])
    # Averaged over a cell, so that sampling it once per cell sees all of it.
    averaged = cv2.blur(inside.astype(np.float32), (max(1, round(cell)),) * 2)
    filled = cv2.warpAffine(averaged, grid, (count, count), flags=cv2.INTER_LINEAR)
    return _Window(view, corner, cell, _blurred(filled), middle, float(np.hypot(*(high - low))), pixels[..., :3])


def _blurred(grid: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(grid.astype(np.float32), (0, 0), 0.8))


def _overlap(points: np.ndarray, windows: Sequence[_Window], *, thin: bool = False) -> np.ndarray:
    """(V,) intersection over union of the points' silhouettes and the masks; ``thin``: few points, whose gaps close."""
    kernel = np.ones((7, 7) if thin else (3, 3), np.uint8)
    values = []
    for window in windows:
        local = points @ window.view.viewmat[:3, :3].T + window.view.viewmat[:3, 3]
        if local[:, 2].min() <= 0:
            values.append(0.0)
            continue
        index = ((_pixels(local, window.view.k) - window.corner) / window.cell).astype(np.int64)
        side = window.filled.shape[0]
        x, y = index.clip(0, side - 1).T
        grid = np.zeros((side, side), np.uint8)
        grid[y, x] = 1
        drawn = _blurred(cv2.morphologyEx(grid, cv2.MORPH_CLOSE, kernel))
        union = float(np.maximum(drawn, window.filled).sum())
        values.append(float(np.minimum(drawn, window.filled).sum()) / union)
    return np.array(values)


def _placed(points: np.ndarray, rotation: np.ndarray, windows: Sequence[_Window]) -> _Fit:
    """The fit of this rotation at which the points have silhouettes of the masks' sizes and middles."""
    turned, scale, shift = points @ rotation.T, 1.0, _crossing(windows)
    for _ in range(PLACING_ROUNDS):
        ratios, normal, right = [], np.zeros((3, 3)), np.zeros(3)
        for window in windows:
            r, k = window.view.viewmat[:3, :3], window.view.k
            depth = max(1e-6, float(r[2] @ shift + window.view.viewmat[2, 3]))
            local = turned * scale @ r.T + (0, 0, depth)
            uv = _pixels(local, k) if local[:, 2].min() > 1e-3 * depth else local[:, :2] / depth * k[0, 0] + k[:2, 2]
            low, high = uv.min(0), uv.max(0)
            ratios.append(math.log(window.extent / max(1e-6, float(np.hypot(*(high - low))))))
            seen = _pixels((r @ shift + window.view.viewmat[:3, 3])[None], k)[0]  # the place's pixel
            now = (low + high) / 2 - k[:2, 2] + seen
            away = (window.middle - now) * depth / k[[0, 1], [0, 1]]
            normal += r[:2].T @ r[:2]
            right += r[:2].T @ away
        scale *= math.exp(float(np.mean(ratios)))
        shift = shift + np.linalg.solve(normal + 1e-9 * np.eye(3), right)
    fit = _Fit(0.0, rotation, scale, shift)
    return fit._replace(overlap=float(_overlap(fit(points), windows, thin=True).mean()))


def _crossing(windows: Sequence[_Window]) -> np.ndarray:
    """The point nearest to the rays through the middles of the masks."""
    viewmats = np.stack([window.view.viewmat for window in windows])
    rays = np.stack([np.linalg.solve(window.view.k, [*window.middle, 1.0]) for window in windows])
    rays = np.einsum("nji,nj->ni", viewmats[:, :3, :3], rays / np.linalg.norm(rays, axis=1, keepdims=True))
    point = nearest_to_lines(centers(viewmats), rays)
    return centers(viewmats).mean(0) if point is None else point


def _refined(body: _Body, windows: Sequence[_Window], start: _Fit, step: float) -> _Fit:
    """The best fit near another one; ``step`` is how far its neighbours are looked for [radian, or of the size]."""
    size = body.size * start.scale

    def moved(values: np.ndarray) -> _Fit:
        turn = Rotation.from_rotvec(values[:3]).as_matrix() @ start.rotation
        return _Fit(0.0, turn, start.scale * math.exp(values[3]), start.shift + size * values[4:])

    def loss(values: np.ndarray) -> float:
        return -float(_overlap(moved(values)(body.points), windows).mean())

    simplex = np.vstack((np.zeros(7), step * np.diag([1, 1, 1, 0.5, 0.3, 0.3, 0.3])))
    options = {"initial_simplex": simplex, "maxfev": REFINEMENT_STEPS, "xatol": 1e-4, "fatol": 1e-5}
    values = minimize(loss, np.zeros(7), method="Nelder-Mead", options=options).x
    return moved(values)._replace(overlap=-loss(values))


def _best(body: _Body, windows: Sequence[_Window], found: list[_Fit]) -> Registration:
    """Of the fits that cover the masks alike, the one whose colours agree best."""
    top = max(fit.overlap for fit in found)
    alike = [fit for fit in found if fit.overlap > top - CLOSE]
    agreement = [_agreement(body, windows, fit) for fit in alike]
    best = alike[int(np.argmax(agreement))]
    others = [a for fit, a in zip(alike, agreement, strict=True) if _angle(fit, best) > APART]
    views = _overlap(best(body.points), windows).tolist()
    move = Similarity(best.scale, best.rotation, best.shift - best.scale * best.rotation @ body.middle)
    by_view = {window.view.name: value for window, value in zip(windows, views, strict=True)}
    return Registration(move, best.overlap, by_view, max(agreement), max(others, default=-1.0))


def _angle(first: _Fit, second: _Fit) -> float:
    """Between the rotations of two fits [degree]."""
    cosine = (np.trace(first.rotation.T @ second.rotation) - 1) / 2
    return math.degrees(math.acos(float(np.clip(cosine, -1, 1))))


def _agreement(body: _Body, windows: Sequence[_Window], fit: _Fit) -> float:
    """Correlation of the hull's colours with the frames', over cameras, whatever exposure and balance they have."""
    points, normals = fit(body.points), body.normals @ fit.rotation.T
    known = np.isfinite(body.colors[:, 0])
    scores = []
    for window in windows:
        colors, seen = _sampled(points, normals, window.view.viewmat, window.view.k, window.rgb)
        chosen = seen & known
        if chosen.sum() < 10:
            continue
        a, b = body.colors[chosen], colors[chosen]
        a, b = a - a.mean(0), b - b.mean(0)
        norm = float(np.linalg.norm(a) * np.linalg.norm(b))
        scores.append(float((a * b).sum()) / norm if norm > 0 else 0.0)
    return float(np.mean(scores)) if scores else 0.0
