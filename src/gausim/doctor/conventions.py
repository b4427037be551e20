"""Common misreadings of calibration files, tested by the agreement of the rest scene with the images."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Cameras, GaussianScene
from gausim.doctor.silhouettes import draw_silhouettes, overlap
from gausim.io.transforms import OPENGL_TO_OPENCV

# Ratios of common units of length: millimetres, centimetres and metres.
_UNITS = (0.001, 0.01, 0.1, 10.0, 100.0, 1000.0)
# Iterations of the estimate of the focal length from areas.
_ROUNDS = 4
_AXES = torch.tensor(OPENGL_TO_OPENCV, dtype=torch.float64)


@dataclass(frozen=True)
class Reading:
    """The calibration under another convention."""

    name: str  # description of the convention
    remedy: str  # what to change
    overlap: float  # mean intersection over union of the silhouettes over the views


def try_readings(scene: GaussianScene, masks: Float[np.ndarray, "V h w"], cameras: Cameras) -> list[Reading]:
    """Readings of the cameras under common conventions, sorted by their fit to the masks of frame 0, the best first."""
    # The matrices of the file: camera to world, OpenGL axes.
    stored = torch.linalg.inv(cameras.viewmats.double()) * _AXES
    readings = []
    for name, remedy, change in _POSES:
        viewmats = torch.stack([change(pose) for pose in stored]).float()
        readings.append(Reading(name, remedy, _fit(scene, masks, replace(cameras, viewmats=viewmats))))
    readings.append(_another_lens(scene, masks, cameras))
    return sorted(readings, key=lambda reading: -reading.overlap)


def _fit(scene: GaussianScene, masks: Float[np.ndarray, "V h w"], cameras: Cameras) -> float:
    drawn = draw_silhouettes(scene, cameras).alpha
    return float(np.mean([overlap(mask, alpha) for mask, alpha in zip(masks, drawn, strict=True)]))


def _read(pose: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    return torch.linalg.inv(pose * _AXES)


def _transposed(pose: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3].T
    return _read(turned)


def _world(quarter: int) -> Callable[[Tensor], Tensor]:
    """Rotation of the world by ±90 degrees about x."""
    turn = torch.tensor([[1, 0, 0, 0], [0, 0, -quarter, 0], [0, quarter, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    return lambda pose: _read(turn @ pose)


def _unit(factor: float) -> Callable[[Tensor], Tensor]:
    scale = torch.tensor([1, 1, 1, factor], dtype=torch.float64)
    return lambda pose: _read(torch.cat((pose[:3] * scale, pose[3:])))


_POSES: list[tuple[str, str, Callable[[Tensor], Tensor]]] = [
    ("camera-to-world matrices in OpenCV axes (y down, looking along +z)",
     "negate the second and third column of every transform_matrix (OpenGL axes: y up, looking along -z)",
     torch.linalg.inv),
    ("world-to-camera matrices in OpenCV axes",
     "invert every transform_matrix (it must be camera to world), then negate its second and third column",
     lambda pose: pose),
    ("world-to-camera matrices in OpenGL axes",
     "invert every transform_matrix: it must be camera to world", lambda pose: _AXES[:, None] * pose),
    ("poses whose rotations are transposed",
     "transpose the upper left 3 x 3 part of every transform_matrix", _transposed),
    ("poses of a world whose up is y, while the scene's up is z",
     "turn every transform_matrix by +90 degrees about x (x, y, z to x, -z, y), or the scene the other way", _world(1)),
    ("poses of a world whose up is z, while the scene's up is y",
     "turn every transform_matrix by -90 degrees about x (x, y, z to x, z, -y), or the scene the other way",
     _world(-1)),
    *((f"positions of cameras in another unit than the scene's (times {factor:g})",
       f"multiply the last column of every transform_matrix by {factor:g}", _unit(factor)) for factor in _UNITS),
]  # fmt: skip


def _another_lens(scene: GaussianScene, masks: Float[np.ndarray, "V h w"], cameras: Cameras) -> Reading:
    """The same poses with the focal length at which silhouettes have the right size."""
    lenses = cameras.Ks.clone()
    for _ in range(_ROUNDS):
        drawn = draw_silhouettes(scene, replace(cameras, Ks=lenses)).alpha
        seen = [v for v in range(len(masks)) if drawn[v].sum() > 0 and masks[v].sum() > 0]
        if not seen:
            break
        ratio = math.sqrt(float(np.median([masks[v].sum() / drawn[v].sum() for v in seen])))
        lenses[:, 0, 0] *= ratio
        lenses[:, 1, 1] *= ratio
    factor = float((lenses[:, 0, 0] / cameras.Ks[:, 0, 0]).median())
    field = math.degrees(2 * math.atan(cameras.width / (2 * float(lenses[:, 0, 0].median()))))
    name = f"a focal length {factor:.3g} times the stated one, which makes a field of view of {field:.3g} degrees"
    remedy = (
        f"multiply fl_x and fl_y by {factor:.3g} (they may have been made from an angle in degrees where radians were "
        "expected, or for pictures of another size; then cx and cy are wrong too)"
    )
    return Reading(name, remedy, _fit(scene, masks, replace(cameras, Ks=lenses)))
