"""Initial Gaussians and their bounds: on the visual hull of the masks, or on points in it."""

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
class PointCloud:
    """Points at which kernels start."""

    points: Float[Tensor, "P 3"]  # positions [scene units]
    colors: Float[Tensor, "P 3"] | None = None  # RGB in [0, 1]; None reads them from the images

    def __post_init__(self) -> None:
        """Checks the numbers, or raises :class:`DataError`."""
        if len(self.points) < 2 or not torch.isfinite(self.points).all():
            raise DataError(
                f"points: expected at least two finite points to start from, got {len(self.points)}. "
                "Find the poses again, or start from the masks' visual hull."
            )


@dataclass(frozen=True, eq=False)
class Start:
    """K initial balls."""

    points: Float[Tensor, "K 3"]  # centres [scene units]
    colors: Float[Tensor, "K 3"]  # RGB in [0, 1]
    scales: Float[Tensor, " K"]  # standard deviations [scene units]
    contains: Callable[[Tensor], Tensor]  # mask of the points (N, 3) that are within bounds
    largest: float  # largest standard deviation [scene units]
    extent: float  # unit of the positions' learning rate [scene units]


def start_object(
    images: ImageSet, count: int, *, resolution: int, missing: float, cloud: PointCloud | None, name: str
) -> Start:
    """``count`` balls evenly over the surface of the visual hull of the masks, or over the points that lie in it.

    The object is where alpha > 0. The hull has ``resolution`` voxels along its longest side; ``missing`` is the
    fraction of the views whose masks may lack a part that all others show.

    Raises:
        DataError: no body projects into all masks, or no point lies in it.
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
    colors = None
    if cloud is not None:
        inside = room.contains(cloud.points)
        if inside.sum() < 2:
            raise DataError(
                f"{name}: {int(inside.sum())} of {len(inside)} points lie in the visual hull of the masks. Check that "
                "points and poses are of one world, or leave the points out."
            )
        points, normals = cloud.points[inside].float(), torch.zeros(int(inside.sum()), 3)
        colors = None if cloud.colors is None else cloud.colors[inside]
    index = farthest_points(points, max(2, count))
    points, normals = points[index], normals[index]
    distance = neighbour_distance(points)
    chosen = _surface_colors(points, normals, images) if colors is None else colors[index]
    scales, ceiling = 0.6 * distance.clamp_min(1e-3 * hull.spacing), OBJECT_CEILING * float(distance.mean())
    return Start(points, chosen, scales, room.contains, ceiling, hull.diagonal)


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
