from __future__ import annotations

import pytest
import torch

from gausim.metrics import motion_energy, point_error


def test_point_error_by_hand() -> None:
    target = torch.zeros(2, 4, 3)
    prediction = target.clone()
    prediction[1, 0] = torch.tensor([3.0, 0.0, 4.0])  # 5 over four points, diagonal 10: 12.5 %
    assert point_error(prediction, target, 10.0).tolist() == pytest.approx([0.0, 12.5])


def test_motion_energy_of_points_and_images_by_hand() -> None:
    frames = torch.zeros(3, 2, 3)
    frames[1, 0, 0] = 2.0  # 4 in the first step, and back again
    frames[2, 1, 1] = 1.0
    assert motion_energy(frames).tolist() == motion_energy(frames[:, None]).tolist() == pytest.approx([4.0, 5.0])
