"""The mixture of L1, squared error, SSIM and opacity: by hand, against the image loss, with gradients."""

from __future__ import annotations

import pytest
import torch

from gausim.core import ConfigError
from gausim.losses.image import ImageLoss
from gausim.losses.mixed import MixedLoss


def images(channels: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    return torch.rand(2, 3, 14, 15, channels, generator=g), torch.rand(2, 3, 14, 15, channels, generator=g)


def test_each_term_is_a_mean() -> None:
    x, y = images(4)
    color = (x - y)[..., :3]
    torch.testing.assert_close(MixedLoss(l1=2.0)(x[..., :3], y[..., :3]), 2 * color.abs().mean((1, 2, 3, 4)))
    expected = 3 * color.square().mean((1, 2, 3, 4)) + 5 * (x - y)[..., 3].square().mean((1, 2, 3))
    loss = MixedLoss(mse=3.0, alpha=5.0)
    assert loss.compares_alpha and not MixedLoss(mse=1.0).compares_alpha
    torch.testing.assert_close(loss(x, y), expected)


def test_ssim_is_that_of_the_image_loss() -> None:
    x, y = images()
    other = ImageLoss(balance=0.0, window=5, pixels=1)  # (1 - SSIM) / 2, summed over channels
    torch.testing.assert_close(MixedLoss(dssim=1.0, window=5)(x, y), 2 / 3 * other(x, y), rtol=1e-4, atol=1e-6)


def test_gradients_are_those_of_the_sum() -> None:
    x, y = (v.double() for v in images(4))
    loss = MixedLoss(l1=0.3, mse=0.2, dssim=0.5, alpha=0.7, window=5)
    values, gradient = loss.value_and_gradient(x, y)
    leaf = x.clone().requires_grad_()
    loss(leaf, y).sum().backward()
    torch.testing.assert_close(leaf.grad, gradient)
    step = 1e-6 * torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    torch.testing.assert_close((loss(x + step, y) - values).sum(), (gradient * step).sum(), rtol=1e-3, atol=1e-10)


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(ConfigError, match="one of them > 0"):
        MixedLoss()
    with pytest.raises(ConfigError, match=r"15x14 pixels.*window of 17"):
        MixedLoss(dssim=1.0, window=17)(*images())
