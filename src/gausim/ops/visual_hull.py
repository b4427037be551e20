"""Visual hull on a voxel grid: the largest body that projects into every foreground mask."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

# Fraction of the views in whose image a point must lie; few cameras see the corners of the search cube.
_MINIMUM_SEEN = 0.5
_COARSE_RESOLUTION = 48


@dataclass(frozen=True, eq=False)
class VoxelHull:
    """A body on a grid of cubic voxels."""

    occupied: Bool[Tensor, "X Y Z"]  # voxels of the body
    origin: Float[Tensor, " 3"]  # centre of voxel (0, 0, 0) [scene units]
    spacing: float  # edge length of a voxel [scene units]

    @property
    def diagonal(self) -> float:
        """Length of the body's bounding-box diagonal [scene units]."""
        x = self.occupied.nonzero()
        return float((x.amax(0) - x.amin(0) + 1).float().norm()) * self.spacing

    def surface(self) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
        """Centres of the voxels with a free face, and outward unit normals there (zero where undefined)."""
        body = self.occupied.float()[None, None]
        padded = functional.pad(body, (1,) * 6)
        cross = torch.zeros(1, 1, 3, 3, 3)
        cross[..., 1, 1, :] = cross[..., 1, :, 1] = cross[..., :, 1, 1] = 1.0
        filled = functional.conv3d(padded, cross)[0, 0]
        index = (self.occupied & (filled < 7)).nonzero()
        smooth = functional.avg_pool3d(functional.pad(body, (3,) * 6), 5, stride=1)[0, 0]
        i, j, k = (index + 1).unbind(-1)  # smooth has a border of one voxel
        slope = (
            smooth[i + 1, j, k] - smooth[i - 1, j, k],
            smooth[i, j + 1, k] - smooth[i, j - 1, k],
            smooth[i, j, k + 1] - smooth[i, j, k - 1],
        )
        return self.origin + index * self.spacing, functional.normalize(-torch.stack(slope, -1), dim=-1)

    def dilated(self, voxels: int) -> "VoxelHull":
        """The body grown by this many voxels in every direction."""
        width = 2 * voxels + 1
        body = functional.pad(self.occupied.float()[None, None], (2 * voxels,) * 6)
        grown = functional.max_pool3d(body, width, stride=1)[0, 0] > 0
        return VoxelHull(grown, self.origin - voxels * self.spacing, self.spacing)

    def contains(self, points: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:
        """True for the points in an occupied voxel."""
        index = ((points - self.origin) / self.spacing).round().long()
        size = torch.tensor(self.occupied.shape, device=points.device)
        inside = ((index >= 0) & (index < size)).all(-1)
        i, j, k = torch.minimum(index.clamp_min(0), size - 1).unbind(-1)
        return inside & self.occupied[i, j, k]


def project(
    points: Float[Tensor, "N 3"], viewmats: Float[Tensor, "V 4 4"], Ks: Float[Tensor, "V 3 3"]
) -> tuple[Float[Tensor, "V N 2"], Float[Tensor, "V N"]]:
    """Pixel coordinates and depths of points in V pinhole views (OpenCV axes)."""
    local = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    depth = local[..., 2]
    pixels = (local @ Ks.mT)[..., :2] / depth.clamp_min(1e-6)[..., None]
    return pixels, depth


def search_cube(
    viewmats: Float[Tensor, "V 4 4"], Ks: Float[Tensor, "V 3 3"], size: tuple[int, int]
) -> tuple[Float[Tensor, " 3"], float]:
    """Centre and half edge of a cube around the region viewed by all cameras.

    The centre is the point nearest to all optical axes in the least-squares sense; the half edge is the largest extent
    of a camera's view at the centre.
    """
    forward = viewmats[:, 2, :3].double()
    centers = -(viewmats[:, :3, :3].double().mT @ viewmats[:, :3, 3, None].double())[..., 0]
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    # Regularisation, for parallel axes (one camera, or a row of them).
    normal = across.sum(0) + 1e-6 * torch.eye(3, dtype=torch.float64)
    middle = torch.linalg.solve(normal, (across @ centers[..., None]).sum(0)[:, 0])
    focal = torch.stack((Ks[:, 0, 0] / size[0], Ks[:, 1, 1] / size[1]), -1).amin(-1).double()
    half = ((middle - centers).norm(dim=-1) / (2 * focal)).max()
    return middle.float(), float(half)


def carve(
    masks: Bool[Tensor, "V H W"],
    viewmats: Float[Tensor, "V 4 4"],
    Ks: Float[Tensor, "V 3 3"],
    resolution: int,
    *,
    missing: float = 0.0,
) -> VoxelHull | None:
    """Visual hull with about ``resolution`` voxels along its longest side; None if it is empty.

    ``missing`` is the fraction of the views whose masks may miss a part; 0: one mask that misses it removes it.
    Points outside an image are not carved by it, so that an object may lie partly outside some images.
    """
    middle, half = search_cube(viewmats, Ks, (masks.shape[2], masks.shape[1]))
    vetoes = int(missing * len(masks))
    coarse = _carve_box(masks, viewmats, Ks, middle - half, middle + half, 2 * half / _COARSE_RESOLUTION, vetoes)
    if not coarse.occupied.any():
        return None
    index = coarse.occupied.nonzero()
    low = coarse.origin + (index.amin(0) - 1) * coarse.spacing
    high = coarse.origin + (index.amax(0) + 1) * coarse.spacing
    return _carve_box(masks, viewmats, Ks, low, high, float((high - low).max()) / resolution, vetoes)


def _carve_box(
    masks: Bool[Tensor, "V H W"],
    viewmats: Float[Tensor, "V 4 4"],
    Ks: Float[Tensor, "V 3 3"],
    low: Float[Tensor, " 3"],
    high: Float[Tensor, " 3"],
    spacing: float,
    vetoes: int,
) -> VoxelHull:
    """The hull on a grid over the box from ``low`` to ``high``; at most ``vetoes`` masks are against its points."""
    axes = [torch.arange(float(low[i]), float(high[i]) + spacing / 2, spacing) for i in range(3)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    points, (height, width) = grid.reshape(-1, 3), masks.shape[1:]
    alive, seen = torch.arange(len(points)), torch.zeros(len(points))
    against = torch.zeros(len(points), dtype=torch.int32)
    # View by view, each on the points left by earlier ones: ten times less work than all points in all views.
    for view in range(len(masks)):
        pixels, depth = project(points[alive], viewmats[view : view + 1], Ks[view : view + 1])
        x, y = pixels[0].floor().long().unbind(-1)  # the centre of pixel i is at i + 0.5
        visible = (depth[0] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        covered = masks[view, y.clamp(0, height - 1), x.clamp(0, width - 1)]
        seen[alive[visible]] += 1
        against[alive[visible & ~covered]] += 1
        alive = alive[against[alive] <= vetoes]
    inside = torch.zeros(len(points), dtype=torch.bool)
    inside[alive] = seen[alive] >= _MINIMUM_SEEN * len(masks)
    return VoxelHull(inside.reshape(grid.shape[:3]), grid[0, 0, 0], spacing)


def farthest_points(points: Float[Tensor, "N 3"], count: int) -> Tensor:
    """Indices of ``count`` points by farthest-point sampling, the first one first."""
    count = min(count, points.shape[0])
    chosen = torch.zeros(count, dtype=torch.long)
    distance = torch.full((points.shape[0],), float("inf"))
    current = 0
    for i in range(count):
        chosen[i] = current
        distance = torch.minimum(distance, (points - points[current]).square().sum(-1))
        current = int(distance.argmax())
    return chosen
