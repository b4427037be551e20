"""Places of bodies in space from their silhouettes in several cameras."""

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Cameras


def centroids(alpha: Float[Tensor, "F V H W"], cameras: Cameras) -> Float[Tensor, "F 3"]:
    """The point nearest to the rays through the silhouettes' centroids, for every frame [scene units]."""
    weight = alpha.sum((2, 3)).clamp_min(1e-12)
    y, x = (torch.arange(n, dtype=alpha.dtype) + 0.5 for n in alpha.shape[2:])
    pixel = torch.stack(((alpha.sum(2) @ x) / weight, (alpha.sum(3) @ y) / weight, torch.ones_like(weight)), -1)
    rays = torch.einsum("vba,vbc,fvc->fva", cameras.viewmats[:, :3, :3].double(),
                        torch.linalg.inv(cameras.Ks.double()), pixel)  # fmt: skip
    rays = rays / rays.norm(dim=-1, keepdim=True)
    across = torch.eye(3, dtype=alpha.dtype) - rays[..., :, None] * rays[..., None, :]
    across = across * (weight > 1e-6).to(alpha)[..., None, None]
    target = (across @ cameras.centers.double()[None, :, :, None]).sum(1)
    return torch.linalg.lstsq(across.sum(1), target).solution[..., 0]
