import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torchmetrics.functional.image import peak_signal_noise_ratio

from gausim.metrics import L2, PSNR, SSIM, ForegroundL2, ForegroundPSNR, ImageMetric, mask_iou


def images(seed: int = 0, count: int = 3, size: int = 24) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    first, second = torch.rand(2, count, size, size + 4, 3, generator=generator)
    mask = torch.rand(count, size, size + 4, generator=generator) > 0.6
    return first, second, mask


def test_l2_of_one_changed_pixel_by_hand():
    target = torch.zeros(2, 4, 5, 3)
    prediction = target.clone()
    prediction[0, 1, 2] = torch.tensor([0.3, 0.0, 0.4])  # norm 0.5 in one of 20 pixels
    mask = torch.zeros(2, 4, 5, dtype=torch.bool)
    mask[:, 1, 2:4] = True  # two foreground pixels
    assert L2().per_image(prediction, target, mask).tolist() == pytest.approx([0.5 / 20, 0.0])
    assert ForegroundL2().per_image(prediction, target, mask).tolist() == pytest.approx([0.25, 0.0])


def test_psnr_agrees_with_torchmetrics_and_sees_masked_pixels_only() -> None:
    prediction, target, mask = images()
    values = PSNR().per_image(prediction, target, mask)
    for i in range(len(values)):
        expected = peak_signal_noise_ratio(prediction[i], target[i], data_range=1.0)
        assert float(values[i]) == pytest.approx(float(expected), rel=1e-5)
    prediction, target, mask = images()
    each = zip(prediction, target, mask, strict=True)
    expected = [-10 * math.log10(float((p[m] - t[m]).square().mean())) for p, t, m in each]
    values = ForegroundPSNR().per_image(prediction, target, mask)
    assert values.tolist() == pytest.approx(expected, rel=1e-5)
    changed = torch.where(mask[..., None], prediction, torch.rand_like(prediction))
    assert torch.equal(ForegroundPSNR().per_image(changed, target, mask), values)


def scipy_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. by hand for one channel: Gaussian window 11, sigma 1.5."""

    def blur(x: np.ndarray) -> np.ndarray:
        return gaussian_filter(x, 1.5, truncate=5 / 1.5, mode="mirror")

    mu_a, mu_b = blur(a), blur(b)
    var_a, var_b, cov = blur(a * a) - mu_a**2, blur(b * b) - mu_b**2, blur(a * b) - mu_a * mu_b
    numerator = (2 * mu_a * mu_b + 0.01**2) * (2 * cov + 0.03**2)
    return float((numerator / ((mu_a**2 + mu_b**2 + 0.01**2) * (var_a + var_b + 0.03**2))).mean())


def test_ssim_agrees_with_the_definition():
    prediction, target, mask = images()
    target = 0.7 * prediction + 0.3 * target
    values = SSIM().per_image(prediction, target, mask)
    for i in range(len(values)):
        channels = [scipy_ssim(prediction[i, ..., c].double().numpy(), target[i, ..., c].double().numpy())
                    for c in range(3)]  # fmt: skip
        assert float(values[i]) == pytest.approx(np.mean(channels), abs=1e-5)


@pytest.mark.parametrize("metric", [L2(), ForegroundL2(), PSNR(), ForegroundPSNR(), SSIM()], ids=lambda m: m.key)
def test_batches_in_any_split_give_the_mean_over_images(metric: ImageMetric):
    prediction, target, mask = images(count=5)
    expected = metric.per_image(prediction, target, mask).double().mean()
    metric.reset()
    metric.update(prediction[:2], target[:2], mask[:2])
    metric.update(prediction[2:], target[2:], mask[2:])
    assert float(metric.compute()) == pytest.approx(float(expected), rel=1e-6)
    metric.reset()


def test_images_without_foreground_do_not_count():
    prediction, target, mask = images()
    mask[1] = False
    metric = ForegroundL2()
    metric.update(prediction, target, mask)
    expected = metric.per_image(prediction, target, mask)[[0, 2]].mean()
    assert float(metric.compute()) == pytest.approx(float(expected), rel=1e-6)


def test_mask_iou_of_shifted_squares() -> None:
    target = torch.zeros(3, 8, 8)
    target[:2, 2:6, 2:6] = 1.0
    prediction = target.roll(2, dims=2)
    prediction[1] = 0.4  # less than half opaque
    found = mask_iou(prediction, target)
    assert found[:2].tolist() == pytest.approx([8 / 24, 0.0])
    assert math.isnan(found[2])
