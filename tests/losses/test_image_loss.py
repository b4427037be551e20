"""The image losses against kornia and formulas, with gradients, and the objective."""

import math

import pytest
import torch
from kornia.losses import ssim_loss
from kornia.metrics import ssim
from torch import Tensor

from gausim.core import ConfigError
from gausim.losses import ImageLoss, Objective, static_loss
from gausim.losses.mixed import MixedLoss
from gausim.ops.similarity import gaussian_taps, structural_similarity


def images(batch: int = 3, height: int = 17, width: int = 23, channels: int = 3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    shape = (batch, 2, height, width, channels)
    return torch.rand(shape, generator=generator), torch.rand(shape, generator=generator)


@pytest.mark.parametrize("window", [5, 11])
def test_ssim_equals_kornia(window: int) -> None:
    first, second = (x.flatten(0, 1).movedim(-1, 1) for x in images())
    ours = structural_similarity(first.flatten(0, 1), second.flatten(0, 1), gaussian_taps(window)).reshape(first.shape)
    torch.testing.assert_close(ours, ssim(first, second, window), atol=2e-5, rtol=0)


def test_ssim_gradient_equals_kornia_and_backward_leaves_it_whole() -> None:
    first, second = (x.flatten(0, 1).movedim(-1, 1).double() for x in images())
    first.requires_grad_(True)
    ours = structural_similarity(first.flatten(0, 1), second.flatten(0, 1), gaussian_taps(5)).mean()
    (expected,) = torch.autograd.grad(ssim(first, second, 5).mean(), first)
    (gradient,) = torch.autograd.grad(ours, first)
    torch.testing.assert_close(gradient, expected, atol=1e-7, rtol=1e-5)
    prediction, target = images(3, 14, 15)
    _, slope = ImageLoss().value_and_gradient(prediction, target)
    prediction.requires_grad_(True)
    loss = ImageLoss()(prediction, target)
    weights = torch.tensor([1.0, -2.0, 0.0])
    for _ in range(2):  # twice through one graph
        (gradient,) = torch.autograd.grad(loss, prediction, weights, retain_graph=True)
        torch.testing.assert_close(gradient, slope * weights[:, None, None, None, None], rtol=0, atol=0)


def test_value_is_the_papers_sum_at_its_image_size() -> None:
    prediction, target = images()
    loss = ImageLoss(balance=0.9)(prediction, target)
    first, second = (x.movedim(-1, 2) for x in (prediction, target))
    for b in range(3):
        squared = (first[b] - second[b]).square().sum() / 2  # two views: their mean
        dissimilar = ssim_loss(first[b], second[b], 5, reduction="sum") / 2
        expected = (0.9 * squared + 0.1 * dissimilar) * 518_400 / (17 * 23)
        torch.testing.assert_close(loss[b], expected, rtol=1e-4, atol=0)


def test_inputs_need_not_be_contiguous() -> None:
    prediction, target = images(2, 18, 15)
    strided = prediction.movedim(-1, 2).contiguous().movedim(2, -1)
    spread = target[:1].expand(2, -1, -1, -1, -1)
    assert not strided.is_contiguous() and not spread.is_contiguous()
    whole = ImageLoss().value_and_gradient(prediction, spread.contiguous())
    parts = ImageLoss().value_and_gradient(strided, spread)
    assert torch.equal(whole[0], parts[0]) and torch.equal(whole[1], parts[1])


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_prediction_that_is_not_finite_gives_such_a_loss(value: float) -> None:
    prediction, target = images(1, 12, 12)
    prediction[0, 0, 5, 6, 2] = value
    assert not torch.isfinite(ImageLoss().value_and_gradient(prediction, target)[0]).any()


@pytest.mark.parametrize("double", [False, True])
def test_images_smaller_than_the_window_are_refused(double: bool) -> None:
    small = torch.zeros(1, 1, 4, 20, 3, dtype=torch.float64 if double else torch.float32)
    with pytest.raises(ConfigError, match=r"20x4 pixels are smaller than the SSIM window of 5"):
        ImageLoss()(small, small)


def test_static_loss_and_the_objectives_windows_and_chances() -> None:
    rest = torch.zeros(4, 3)
    assert float(static_loss(rest + 2.0, rest, torch.full((len(rest), 1), 4.0))) == pytest.approx(3.0)
    assert Objective().static_chance(5) == pytest.approx(0.2)
    assert Objective(static_probability=0.5).static_chance(5) == 0.5
    assert Objective(static_weight=0.0).static_chance(1) == 0.0
    assert [Objective(backprop_steps=k).window(6) for k in (0, 1, 4, 9)] == [6, 1, 4, 6]


def test_terms_of_a_mixture_are_means_with_the_gradients_of_their_sum() -> None:
    x, y = images(channels=4)
    color = (x - y)[..., :3]
    torch.testing.assert_close(MixedLoss(l1=2.0)(x[..., :3], y[..., :3]), 2 * color.abs().mean((1, 2, 3, 4)))
    expected = 3 * color.square().mean((1, 2, 3, 4)) + 5 * (x - y)[..., 3].square().mean((1, 2, 3))
    loss = MixedLoss(mse=3.0, alpha=5.0)
    assert loss.compares_alpha and not MixedLoss(mse=1.0).compares_alpha
    torch.testing.assert_close(loss(x, y), expected)
    x, y = (v.double() for v in images(channels=4))
    loss = MixedLoss(l1=0.3, mse=0.2, dssim=0.5, alpha=0.7, window=5)
    values, gradient = loss.value_and_gradient(x, y)
    leaf = x.clone().requires_grad_()
    loss(leaf, y).sum().backward()
    torch.testing.assert_close(leaf.grad, gradient)
    step = 1e-6 * torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    torch.testing.assert_close((loss(x + step, y) - values).sum(), (gradient * step).sum(), rtol=1e-3, atol=1e-10)


def test_ssim_of_a_mixture_is_that_of_the_image_loss() -> None:
    x, y = images()
    other = ImageLoss(balance=0.0, window=5, pixels=1)  # (1 - SSIM) / 2, summed over channels
    torch.testing.assert_close(MixedLoss(dssim=1.0, window=5)(x, y), 2 / 3 * other(x, y), rtol=1e-4, atol=1e-6)
