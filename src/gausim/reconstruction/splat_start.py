"""Initial Gaussians and their bounds, on the visual hull of the masks."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from gausim.core import DataError
from gausim.ops.visual_hull import carve, farthest_points, project
from gausim.reconstruction.stills import ImageSet

# Least alpha (of 255) of pixels from which initial colours are read; the rim is mixed with the background.
OPAQUE = 200
# Number of neighbours whose mean distance determines the size of a kernel at the start.
NEIGHBOURS = 3
# Distance by which a kernel's centre may leave the hull [voxels].
MARGIN = 1
# Largest standard deviation of an object's kernels [mean distances between neighbours at the start].
OBJECT_CEILING = 1.5


@dataclass(frozen=True, eq=False)
class Start:
    """K initial balls."""

    points: Float[Tensor, "K 3"]  # centres [scene units]
    colors: Float[Tensor, "K 3"]  # RGB in [0, 1]
    scales: Float[Tensor, " K"]  # standard deviations [scene units]
    contains: Callable[[Tensor], Tensor]  # mask of the points (N, 3) that are within bounds
    largest: float  # largest standard deviation [scene units]
    extent: float  # unit of the positions' learning rate [scene units]


def start_object(images: ImageSet, count: int, *, resolution: int, missing: float, name: str) -> Start:
    """``count`` balls evenly over the surface of the visual hull of the masks.

    The object is where alpha > 0. The hull has ``resolution`` voxels along its longest side; ``missing`` is the
    fraction of the views whose masks may lack a part that all others show.

    Raises:
        DataError: no body projects into all masks.
    """
    masks = images.images[..., 3] > 0
    hull = carve(masks, images.cameras.viewmats, images.cameras.Ks, resolution, missing=missing)
    if hull is None:
        raise DataError(
            f"{name}: the visual hull of {len(masks)} masks is empty; expected a body that all views see. "
            "Check that the alpha channel is the object's mask and that the poses belong to the images, or allow some "
            "masks to miss parts (--missing-masks 0.2)."
        )
    room = hull.dilated(MARGIN)
    points, normals = hull.surface()
    index = farthest_points(points, max(2, count))
    points, normals = points[index], normals[index]
    distance = neighbour_distance(points)
    colors = _surface_colors(points, normals, images)
    scales, ceiling = 0.6 * distance.clamp_min(1e-3 * hull.spacing), OBJECT_CEILING * float(distance.mean())
    return Start(points, colors, scales, room.contains, ceiling, hull.diagonal)


def neighbour_distance(points: Float[Tensor, "K 3"]) -> Float[Tensor, " K"]:
    """Mean distance of every point to its nearest neighbours [scene units]."""
    count = min(NEIGHBOURS + 1, len(points))
    distances, _ = cKDTree(points.numpy()).query(points.numpy(), k=count)
    return torch.from_numpy(distances[:, 1:].mean(-1)).to(points)


def _surface_colors(
    points: Float[Tensor, "K 3"], normals: Float[Tensor, "K 3"], images: ImageSet
) -> Float[Tensor, "K 3"]:
    """Mean colour over the views that a point's normal faces; occlusion by other parts is left to the optimiser."""
    pixels, _ = project(points, images.cameras.viewmats, images.cameras.Ks)
    total, weight = torch.zeros_like(points), torch.full((len(points), 1), 1e-6)
    mean = images.images[..., :3][images.images[..., 3] > OPAQUE].float().mean(0) / 255
    for view, center in enumerate(images.cameras.centers):
        x, y = pixels[view].floor().long().unbind(-1)
        x, y = x.clamp(0, images.cameras.width - 1), y.clamp(0, images.cameras.height - 1)
        rgba = images.images[view, y, x]
        facing = (normals * functional.normalize(center - points, dim=-1)).sum(-1).clamp_min(1e-3)
        w = (facing**4 * (rgba[:, 3] > OPAQUE))[:, None]
        total, weight = total + w * rgba[:, :3].float() / 255, weight + w
    return (total + 1e-6 * mean) / weight
