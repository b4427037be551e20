from __future__ import annotations

import pytest
import torch
from kornia.losses import ssim_loss
from kornia.metrics import ssim

from gausim.core import ConfigError
from gausim.losses import ImageLoss, Objective, static_loss, structural_similarity


def images(batch: int = 3, height: int = 17, width: int = 23) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shape = (batch, 2, height, width, 3)
    return torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)


def framed(x: torch.Tensor) -> torch.Tensor:
    """The image on a black canvas that is much larger and where it stands off the centre."""
    canvas = torch.zeros(*x.shape[:2], 48, 40, 3)
    canvas[:, :, 9 : 9 + x.shape[2], 6 : 6 + x.shape[3]] = x
    return canvas


@pytest.mark.parametrize("window", [5, 11])
def test_ssim_equals_kornia(window: int) -> None:
    first, second = (x.flatten(0, 1).movedim(-1, 1) for x in images())
    ours = structural_similarity(first.flatten(0, 1), second.flatten(0, 1), window).reshape(first.shape)
    torch.testing.assert_close(ours, ssim(first, second, window), atol=2e-5, rtol=0)


def test_ssim_gradient_equals_kornia() -> None:
    first, second = (x.flatten(0, 1).movedim(-1, 1).double() for x in images())
    first.requires_grad_(True)
    ours = structural_similarity(first.flatten(0, 1), second.flatten(0, 1), 5).mean()
    (expected,) = torch.autograd.grad(ssim(first, second, 5).mean(), first)
    (gradient,) = torch.autograd.grad(ours, first)
    torch.testing.assert_close(gradient, expected, atol=1e-7, rtol=1e-5)


def test_value_is_the_papers_sum_at_its_image_size() -> None:
    prediction, target = images()
    loss = ImageLoss(crop=False)(prediction, target)
    first, second = (x.movedim(-1, 2) for x in (prediction, target))
    for b in range(3):
        squared = (first[b] - second[b]).square().sum() / 2  # two views: their mean
        dissimilar = ssim_loss(first[b], second[b], 5, reduction="sum") / 2
        expected = (0.9 * squared + 0.1 * dissimilar) * 518_400 / (17 * 23)
        torch.testing.assert_close(loss[b], expected, rtol=1e-4, atol=0)


def test_crop_to_what_is_not_black_is_exact() -> None:
    prediction, target = (framed(x) for x in images())
    prediction.requires_grad_(True)
    cropped, whole = (ImageLoss(crop=crop)(prediction, target) for crop in (True, False))
    torch.testing.assert_close(cropped, whole, rtol=1e-5, atol=0)
    gradients = [torch.autograd.grad(x.sum(), prediction)[0] for x in (cropped, whole)]
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-2)


def test_equal_images_cost_nothing_and_black_ones_do_not_fail() -> None:
    image = framed(images()[0])
    assert float(ImageLoss()(image, image).abs().max()) < 1e-1  # of losses of order 1e5
    black = torch.zeros_like(image)
    assert float(ImageLoss()(black, black).abs().max()) == 0.0


def test_static_loss_sums_squared_distances() -> None:
    rest = torch.zeros(4, 3)
    assert float(static_loss(rest + 2.0, rest, torch.full((len(rest), 1), 4.0))) == pytest.approx(3.0)


def test_objective_windows_and_chances() -> None:
    assert Objective().static_chance(5) == pytest.approx(0.2)
    assert Objective(static_probability=0.5).static_chance(5) == 0.5
    assert Objective(static_weight=0.0).static_chance(1) == 0.0
    assert [Objective(backprop_steps=k).window(6) for k in (0, 1, 4, 9)] == [6, 1, 4, 6]


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="odd window"):
        ImageLoss(window=4)
    with pytest.raises(ConfigError, match="mixing_weight"):
        Objective(mixing_weight=-1.0)
