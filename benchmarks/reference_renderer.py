"""The reference renderer: Gaussian splatting in plain torch, any floating type, differentiated by autograd."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gausim.core import Rendered
from gausim.render.limits import ALPHA_MAX, ALPHA_MIN, CLAMP_MARGIN, DILATION, NEAR

T_STOP = 1e-4  # a kernel that would leave less transmittance than this ends its pixel (3DGS)
TILE = 16  # [pixels]


class ReferenceRenderer:
    """EWA splatting after gsplat, sorted by depth and composited front to back (core.Renderer).

    Works in the type and on the device of its inputs. Kernels are culled per tile only where alpha < 1/255 at every
    pixel, so the result equals the sum over all kernels. Memory grows with the kernels of the fullest tile.
    """

    def __call__(
        self,
        means: Float[Tensor, "B K 3"],
        covars: Float[Tensor, "B K 3 3"],
        colors: Float[Tensor, "B V K 3"],
        opacities: Float[Tensor, "B K"],
        viewmats: Float[Tensor, "B V 4 4"],
        Ks: Float[Tensor, "B V 3 3"],
        size: tuple[int, int],
        *,
        background: Float[Tensor, " 3"] | None = None,
    ) -> Rendered:
        """Draws B states in V views each (see core.Renderer)."""
        behind = means.new_zeros(3) if background is None else background.to(means)
        states, views = viewmats.shape[:2]
        drawn = [
            self._view(means[b], covars[b], colors[b, v], opacities[b], viewmats[b, v], Ks[b, v], size)
            for b in range(states)
            for v in range(views)
        ]
        image, through = (torch.stack(parts).unflatten(0, (states, views)) for parts in zip(*drawn, strict=True))
        return Rendered(image + through[..., None] * behind, 1 - through)

    def _view(
        self,
        means: Float[Tensor, "K 3"],
        covars: Float[Tensor, "K 3 3"],
        colors: Float[Tensor, "K 3"],
        opacities: Float[Tensor, " K"],
        viewmat: Float[Tensor, "4 4"],
        K: Float[Tensor, "3 3"],
        size: tuple[int, int],
    ) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
        """Colour before the background, and remaining transmittance of one view."""
        camera = means @ viewmat[:3, :3].T + viewmat[:3, 3]
        visible = (camera[:, 2] > NEAR) & (opacities >= ALPHA_MIN)
        index = visible.nonzero()[:, 0]
        index = index[torch.argsort(camera[index, 2].detach(), stable=True)]
        mean2d, covar2d = project(camera[index], covars[index], viewmat[:3, :3], K, size)
        parts = mean2d, inverse_2x2(covar2d), opacities[index, None], colors[index]
        kernels = torch.cat(parts, 1)
        # Half width and half height of the ellipse within which alpha >= 1/255 [pixels].
        t = 2 * torch.log(255 * opacities[index].detach()).clamp_min(0.0)
        reach = torch.sqrt(t[:, None] * covar2d.detach().diagonal(dim1=-2, dim2=-1))
        width, height = size
        columns, rows = -(-width // TILE), -(-height // TILE)
        hits = _tile_hits(mean2d.detach(), reach, columns, rows)
        tiles = [self._tile(kernels, hit, TILE * (i % columns), TILE * (i // columns)) for i, hit in enumerate(hits)]
        image = torch.stack(tiles).reshape(rows, columns, TILE, TILE, 4).transpose(1, 2)
        image = image.reshape(rows * TILE, columns * TILE, 4)[:height, :width]
        return image[..., :3], image[..., 3]

    def _tile(self, kernels: Float[Tensor, "n 9"], hit: Int[Tensor, " m"], left: int, top: int) -> Tensor:
        """Colour and remaining transmittance of one tile's pixels, (TILE * TILE, 4)."""
        if hit.numel() == 0:
            # The empty sum keeps an image without kernels differentiable (its loss gradients are zero).
            return kernels.new_tensor((0.0, 0.0, 0.0, 1.0)).expand(TILE * TILE, 4) + kernels[:0].sum()
        k = kernels[hit]
        axis = torch.arange(TILE, dtype=k.dtype, device=k.device) + 0.5
        dx = (axis + left)[None, :, None] - k[:, 0]  # (1, x, m)
        dy = (axis + top)[:, None, None] - k[:, 1]  # (y, 1, m)
        power = -(0.5 * k[:, 2] * dx * dx + dy * (k[:, 3] * dx + 0.5 * k[:, 4] * dy)).reshape(TILE * TILE, -1)
        raw = k[:, 5] * torch.exp(power)
        alpha = torch.where(raw.detach() >= ALPHA_MIN, raw.clamp_max(ALPHA_MAX), 0.0)
        through = torch.cumprod(1 - alpha, 1)
        keep = through.detach() > T_STOP  # a prefix of the kernels, because the product never grows
        before = torch.cat((torch.ones_like(through[:, :1]), through[:, :-1]), 1)
        weight = torch.where(keep, alpha * before, 0.0)
        ends = torch.cat((torch.ones_like(through[:, :1]), through), 1)
        return torch.cat((weight @ k[:, 6:9], ends.gather(1, keep.sum(1, keepdim=True))), 1)


def project(
    camera: Float[Tensor, "K 3"],
    covars: Float[Tensor, "K 3 3"],
    rotation: Float[Tensor, "3 3"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
) -> tuple[Float[Tensor, "K 2"], Float[Tensor, "K 2 2"]]:
    """Image mean [pixels] and dilated image covariance [pixels^2] of kernels in camera space.

    EWA: the projection is linearised at the kernel's centre, which as in gsplat is clamped to a slightly widened field
    of view, so that covariances of kernels far outside stay small.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    x, y, z = camera.unbind(-1)
    mean2d = torch.stack((fx * x / z + cx, fy * y / z + cy), -1)
    width, height = size
    margin_x, margin_y = CLAMP_MARGIN * 0.5 * width / fx, CLAMP_MARGIN * 0.5 * height / fy
    qx = torch.clamp(x / z, -(cx / fx + margin_x), (width - cx) / fx + margin_x)
    qy = torch.clamp(y / z, -(cy / fy + margin_y), (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    rows = torch.stack((fx / z, zero, -fx * qx / z), -1), torch.stack((zero, fy / z, -fy * qy / z), -1)
    m = torch.stack(rows, -2) @ rotation
    covar2d = m @ covars @ m.mT
    covar2d = 0.5 * (covar2d + covar2d.mT) + DILATION * torch.eye(2, dtype=m.dtype, device=m.device)
    return mean2d, covar2d


def inverse_2x2(matrix: Float[Tensor, "K 2 2"]) -> Float[Tensor, "K 3"]:
    """Upper triangle (A, B, C) of the inverse of symmetric matrices."""
    a, b, c = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    return torch.stack((c, -b, a), -1) / (a * c - b * b)[:, None]


def _tile_hits(
    mean2d: Float[Tensor, "K 2"], reach: Float[Tensor, "K 2"], columns: int, rows: int
) -> list[Int[Tensor, " m"]]:
    """For every tile, row by row, the kernels whose ellipse's bounding box touches it, in the given order."""
    margin = 0.01  # [pixels], far above the rounding error of float32
    low, high = mean2d - reach - margin, mean2d + reach + margin

    def overlap(axis: int, tiles: int) -> Bool[Tensor, "tiles K"]:
        edge = torch.arange(tiles, device=mean2d.device)[:, None] * float(TILE)
        return (high[:, axis] >= edge) & (low[:, axis] <= edge + TILE)

    in_row, in_column = overlap(1, rows), overlap(0, columns)
    return [(in_row[r] & in_column[c]).nonzero()[:, 0] for r in range(rows) for c in range(columns)]
