"""Metrics of images and of motion: points, energies, bounces and oscillations."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from torchmetrics.functional.image import peak_signal_noise_ratio

from gausim.metrics import (
    L2,
    PSNR,
    SSIM,
    ForegroundL2,
    ForegroundPSNR,
    ImageMetric,
    bounce,
    chamfer,
    mask_iou,
    motion_energy,
    point_error,
    track_error,
)
from gausim.metrics.motion import MOST_POINTS
from gausim.metrics.oscillation import coordinates, principal_motions, spectrum


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


def test_errors_and_energies_by_hand() -> None:
    target = torch.zeros(2, 4, 3)
    prediction = target.clone()
    prediction[1, 0] = torch.tensor([3.0, 0.0, 4.0])  # 5 over four points [scene units]; diagonal 10: 12.5 %
    assert track_error(prediction, target).tolist() == pytest.approx([0.0, 1.25])
    assert point_error(prediction, target, 10.0).tolist() == pytest.approx([0.0, 12.5])
    frames = torch.zeros(3, 2, 3)
    frames[1, 0, 0] = 2.0  # 4 in the first step, and back again
    frames[2, 1, 1] = 1.0
    assert motion_energy(frames).tolist() == motion_energy(frames[:, None]).tolist() == pytest.approx([4.0, 5.0])


def test_chamfer_distance_is_one_sided_and_thins_many_points() -> None:
    line = torch.stack((torch.arange(5.0), torch.zeros(5), torch.zeros(5)), 1)
    lifted = (line + torch.tensor([0.0, 0.25, 0.0])).flip(0)
    assert chamfer(lifted[None], line[None]).tolist() == pytest.approx([0.25])
    # Every true point is hit, the predicted one beside them does not count; the other way round it does.
    more = torch.cat((line, torch.tensor([[0.0, 6.0, 0.0]])))
    assert chamfer(more[None], line[None]).tolist() == [0.0]
    assert chamfer(line[None], more[None]).tolist() == pytest.approx([1.0])
    target = torch.rand(1, MOST_POINTS + 1, 3, generator=torch.Generator().manual_seed(0))
    shifted = target + torch.tensor([0.0, 0.0, 7.0])
    near = torch.cdist(target[0, ::2], shifted[0]).amin(1).mean()
    assert chamfer(shifted, target).item() == pytest.approx(near.item(), rel=1e-5)


def test_bounce_of_a_ball_that_keeps_a_quarter_of_its_height() -> None:
    """Two points 0.2 below and above a centre that falls from 1 and comes up to 0.4 + 0.15 again."""
    centre = np.array([1.0, 0.9, 0.6, 0.19, 0.1, 0.2, 0.45, 0.55, 0.5, 0.3])
    heights = np.stack((centre - 0.2, centre + 0.2), 1)
    found = bounce(heights, diagonal=1.0)
    assert (found.height, found.rise, found.depth) == pytest.approx((0.55, 0.45, 0.1))


@pytest.mark.parametrize("centre", [[1.0, 0.9, 0.8], [1.0, 0.4, 0.0, 0.0]])
def test_no_bounce_without_contact_or_rise(centre: list[float]) -> None:
    found = bounce(np.array(centre)[:, None], diagonal=1.0)
    assert math.isnan(found.height) and math.isnan(found.rise) and found.depth == 0


FPS = 24.0


def ring(frequency: float, frames: int) -> np.ndarray:
    return np.cos(2 * np.pi * frequency / FPS * np.arange(frames))


def test_shapes_are_orthonormal_sorted_and_rebuild_the_motion() -> None:
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(30, 3)))[0].T
    sizes = np.array([5.0, 2.0, 0.5])
    motions = [(rng.normal(size=(20, 3)) * sizes) @ basis for _ in range(3)]
    displacements = [m.reshape(20, 10, 3) for m in motions]
    shapes, fraction = principal_motions(displacements, 8)
    assert shapes.shape == (3, 30) and fraction.sum() == pytest.approx(1)  # no more than there are
    assert list(fraction) == sorted(fraction, reverse=True)
    np.testing.assert_allclose(shapes @ shapes.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(coordinates(displacements[1], shapes) @ shapes, motions[1], atol=1e-9)
    expected = sum((m @ m.T).trace() for m in motions)
    first = sum(float((coordinates(d, shapes)[:, 0] ** 2).sum()) for d in displacements)
    assert fraction[0] == pytest.approx(first / expected)


def test_spectrum_peaks_at_the_frequencies_and_keeps_the_power() -> None:
    series = np.stack((2 * ring(2.0, 240), ring(6.0, 240)), 1)
    frequency, power = spectrum([series, series], FPS)
    assert frequency[power.argmax()] == pytest.approx(2.0)
    assert power[np.isclose(frequency, 6.0)] == pytest.approx(power.max() / 4, rel=1e-6)
    assert power.sum() * frequency[1] == pytest.approx((4 + 1) / 2, rel=1e-6)  # mean squares of the two waves
