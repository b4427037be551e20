"""A scene of random kernels, every field another."""

import torch

from gausim.core import GaussianScene

FIELDS = ("means", "log_scales", "quats", "opacity_logits", "sh", "simulated", "pinned", "foreground")


def random_scene(count: int = 7, degree: int = 1, *, seed: int = 0, masks: bool = True) -> GaussianScene:
    g, number = torch.Generator().manual_seed(seed), torch.arange(count)
    chosen = {"simulated": number < count - 1, "pinned": number < 2, "foreground": number >= 2} if masks else {}
    return GaussianScene.create(
        means=torch.randn(count, 3, generator=g),
        log_scales=torch.randn(count, 3, generator=g) * 0.5 - 3,
        quats=torch.randn(count, 4, generator=g),
        opacity_logits=torch.randn(count, generator=g) * 3,
        sh=torch.randn(count, (degree + 1) ** 2, 3, generator=g),
        volume_scale=37.5,
        name="scene",
        **chosen,
    )
