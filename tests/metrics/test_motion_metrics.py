from __future__ import annotations

import pytest
import torch

from gausim.metrics import Error3D, MotionEnergyRatio, motion_energy, point_error


def test_point_error_by_hand():
    target = torch.zeros(2, 4, 3)
    prediction = target.clone()
    prediction[1, 0] = torch.tensor([3.0, 0.0, 4.0])  # 5 over four points, diagonal 10: 12.5 %
    assert point_error(prediction, target, 10.0).tolist() == pytest.approx([0.0, 12.5])


def test_error_3d_weighs_every_frame_alike():
    generator = torch.Generator().manual_seed(1)
    prediction, target = torch.rand(2, 5, 4, 3, generator=generator)
    metric = Error3D()
    metric.update(prediction[:2], target[:2], 2.0)
    metric.update(prediction[2:], target[2:], 2.0)
    expected = 50 * ((prediction - target) ** 2).sum(-1).sqrt().mean()
    assert float(metric.compute()) == pytest.approx(float(expected), rel=1e-6)


def test_a_frame_that_is_not_a_number_is_not_left_out():
    metric = Error3D()
    prediction = torch.zeros(3, 4, 3)
    metric.update(prediction, torch.ones(3, 4, 3), 2.0)
    prediction[1, 2, 0] = torch.nan
    metric.update(prediction, torch.ones(3, 4, 3), 2.0)
    assert torch.isnan(metric.compute())


def test_motion_energy_by_hand_with_mass():
    frames = torch.zeros(3, 2, 3)
    frames[1, 0, 0] = 2.0  # 4 in the first step, and back again
    frames[2, 1, 1] = 1.0
    assert motion_energy(frames).tolist() == pytest.approx([4.0, 5.0])
    assert motion_energy(frames, torch.tensor([0.5, 3.0])).tolist() == pytest.approx([2.0, 5.0])


def test_energy_of_images_sums_over_all_pixels():
    frames = torch.rand(4, 6, 5, 3, generator=torch.Generator().manual_seed(2))
    expected = [float(((frames[i + 1] - frames[i]) ** 2).sum()) for i in range(3)]
    assert motion_energy(frames).tolist() == pytest.approx(expected, rel=1e-5)


def test_energy_ratio_is_quadratic_in_amplitude_and_pools_sequences():
    generator = torch.Generator().manual_seed(3)
    first, second = torch.rand(2, 5, 4, 3, generator=generator)
    metric = MotionEnergyRatio()
    metric.update(0.5 * first, first)
    assert float(metric.compute()) == pytest.approx(0.25, rel=1e-6)
    metric.update(torch.zeros_like(second), second)
    true = motion_energy(first).sum() + motion_energy(second).sum()
    assert float(metric.compute()) == pytest.approx(float(0.25 * motion_energy(first).sum() / true), rel=1e-5)


def test_energy_ratio_without_true_motion_is_undefined():
    metric = MotionEnergyRatio()
    metric.update(torch.rand(3, 2, 3), torch.ones(3, 2, 3))
    assert torch.isnan(metric.compute())
