"""Silhouettes of the rest scene, and their alignment with the masks."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from gausim.core import Cameras, GaussianScene
from gausim.ops.triangulation import centroids
from gausim.ops.visual_hull import project
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import draw_still

# Smoothing [pixels], steps and precision of the alignment (cv2.findTransformECC).
_SMOOTHING, _STEPS, _PRECISION = 5, 100, 1e-5
# Cameras among which a displaced one stands out, so that the place of a free body is measured without it.
_ENOUGH = 4


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """The rest scene's foreground in V views."""

    alpha: Float[np.ndarray, "V h w"]  # coverage, 0 to 1
    rgb: Float[np.ndarray, "V h w 3"]  # colours over black, 0 to 1


@dataclass(frozen=True)
class Fit:
    """Alignment of a rendered silhouette with a mask."""

    overlap: float  # intersection over union
    aligned: float  # the same after the best shift and rotation in the image
    shift: tuple[float, float]  # at the mask's centre, right and down [reduced pixels]; NaN if nothing is rendered
    turn: float  # rotation in the image [degrees]
    # root mean square of the displacement over the mask [reduced pixels]; infinite if nothing is rendered
    pixels: float
    degrees: float  # rotation of the camera that would explain it


def draw_silhouettes(
    scene: GaussianScene, cameras: Cameras, at: Float[np.ndarray, "V h w"] | None = None
) -> Silhouettes:
    """Renders the rest scene's foreground; with masks ``at``, a free body's, moved to where these are."""
    shown, renderer = scene.select(scene.foreground), CpuRenderer()
    if at is not None:
        place = centroids(torch.from_numpy(at)[None].double(), cameras)[0]
        shown = replace(shown, means=shown.means + (place - shown.means.double().mean(0)).float())
        way = _way(draw_still(renderer, shown, cameras).alpha[0], torch.from_numpy(at), cameras)
        shown = replace(shown, means=shown.means + way.float())
    drawn = draw_still(renderer, shown, cameras)
    return Silhouettes(drawn.alpha[0].clamp(0, 1).numpy(), drawn.rgb[0].clamp(0, 1).numpy())


def _way(drawn: Float[Tensor, "V h w"], masks: Float[Tensor, "V h w"], cameras: Cameras) -> Float[Tensor, " 3"]:
    """Translation of a body that brings its silhouettes to the masks, by all cameras but the one that fits worst."""
    views = range(len(masks))
    ways = []
    for left in views if len(views) >= _ENOUGH else (-1,):
        kept = [v for v in views if v != left]
        some, silhouettes = cameras.select(kept), torch.stack((drawn[kept], masks[kept])).double()
        ends = centroids(silhouettes, some)
        seen = torch.from_numpy(centres(silhouettes.numpy()))
        pixels = project(ends, some.viewmats.double(), some.Ks.double())[0]
        ways.append(
            (float(((pixels[:, 1] - pixels[:, 0]) - (seen[1] - seen[0])).norm(dim=-1).max()), ends[1] - ends[0])
        )
    return min(ways, key=lambda way: way[0])[1]


def overlap(a: Float[np.ndarray, "*shape"], b: Float[np.ndarray, "*shape"]) -> float:
    """Intersection over union of two soft masks; 0 if both are empty."""
    union = float(np.maximum(a, b).sum())
    return float(np.minimum(a, b).sum()) / union if union > 0 else 0.0


def centres(masks: Shaped[np.ndarray, "*n h w"]) -> Float[np.ndarray, "*n 2"]:
    """Columns and rows of the centres of soft masks [pixels]; 0 for an empty one."""
    weights = masks.astype(np.float64)
    rows, columns = np.indices(masks.shape[-2:])
    sums = np.stack(((weights * columns).sum((-1, -2)), (weights * rows).sum((-1, -2))), -1)
    return sums / np.maximum(weights.sum((-1, -2)), 1)[..., None]


def fit_silhouette(mask: Float[np.ndarray, "h w"], drawn: Float[np.ndarray, "h w"], focal: float) -> Fit:
    """Shift and rotation in the image that align a rendered silhouette with a mask (enhanced correlation).

    Both images are in [0, 1]; ``focal`` is the focal length [pixels].
    """
    raw = overlap(mask, drawn)
    if mask.sum() < 1 or drawn.sum() < 1:
        return Fit(raw, raw, (math.nan, math.nan), 0.0, math.inf, math.inf)
    middle = centres(mask)
    warp = np.eye(2, 3, dtype=np.float32)
    warp[:, 2] = centres(drawn) - middle
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _STEPS, _PRECISION)
    try:
        _, found = cv2.findTransformECC(mask, drawn, warp.copy(), cv2.MOTION_EUCLIDEAN, stop, None, _SMOOTHING)  # type: ignore[call-overload]
    except cv2.error:  # without overlap, only the shift of the centres is known
        found = warp
    size = (mask.shape[1], mask.shape[0])
    moved = cv2.warpAffine(drawn, found, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    rows, columns = np.nonzero(mask > 0.5) if (mask > 0.5).any() else np.nonzero(mask > 0)
    places = np.stack((columns, rows)).astype(np.float64)
    away = found[:, :2] @ places + found[:, 2:] - places
    # Positive if the rendered silhouette is right of and below the mask.
    shift = found[:, :2].astype(np.float64) @ middle + found[:, 2] - middle
    turn = math.degrees(math.atan2(found[1, 0], found[0, 0]))
    tilt = math.degrees(math.atan(float(np.hypot(*shift)) / focal))
    pixels = float(np.sqrt((away**2).sum(0).mean()))
    return Fit(raw, overlap(mask, moved), (float(shift[0]), float(shift[1])), turn, pixels, math.hypot(tilt, turn))
