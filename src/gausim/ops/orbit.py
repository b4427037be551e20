"""Cameras on a circle around a scene."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Cameras

# Fraction of the kernels within the picture; captures have outlying kernels.
_WITHIN = 0.98
_FIELD_OF_VIEW = math.radians(40)


def orbit_cameras(
    means: Float[Tensor, "K 3"],
    *,
    azimuths: Sequence[float],
    elevation: float = 15.0,
    up: str = "z",
    size: tuple[int, int] = (480, 480),
) -> Cameras:
    """Cameras on a circle about the middle of a scene, at a distance at which the scene fits into the picture.

    Azimuths about the vertical ``up`` (x, y or z, with a minus sign where it points down) and the elevation above
    the horizon are in degrees, ``size`` (width, height) in pixels.
    """
    middle = means.median(0).values.double()
    radius = float(torch.quantile((means.double() - middle).norm(dim=-1), _WITHIN))
    axis = "xyz".index(up[-1])
    vertical = torch.zeros(3, dtype=torch.float64)
    vertical[axis] = -1.0 if up.startswith("-") else 1.0
    front = torch.zeros(3, dtype=torch.float64)
    front[(axis + 1) % 3] = 1.0
    side = torch.linalg.cross(vertical, front)
    lift, viewmats = math.radians(elevation), []
    for azimuth in map(math.radians, azimuths):
        flat = front * math.cos(azimuth) + side * math.sin(azimuth)
        direction = flat * math.cos(lift) + vertical * math.sin(lift)
        eye = middle + direction * radius / math.sin(_FIELD_OF_VIEW / 2)
        viewmats.append(look_at(eye, middle, vertical))
    focal = min(size) / (2 * math.tan(_FIELD_OF_VIEW / 2))
    k = torch.tensor([[focal, 0.0, size[0] / 2], [0.0, focal, size[1] / 2], [0.0, 0.0, 1.0]])
    names = tuple(f"azimuth_{a:g}" for a in azimuths)
    return Cameras(torch.stack(viewmats).float(), k.expand(len(names), 3, 3), *size, names)


def look_at(eye: Float[Tensor, " 3"], target: Float[Tensor, " 3"], up: Float[Tensor, " 3"]) -> Float[Tensor, "4 4"]:
    """World-to-camera matrix (OpenCV axes) of a camera at ``eye`` with ``target`` in its middle and ``up`` upwards."""
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward))
    viewmat = torch.eye(4, dtype=eye.dtype)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    return viewmat
