from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gausim.metrics import bounce, chamfer, mask_iou, track_error
from gausim.metrics.motion import MOST_POINTS


def test_chamfer_distance_is_one_sided_and_needs_no_order() -> None:
    line = torch.stack((torch.arange(5.0), torch.zeros(5), torch.zeros(5)), 1)
    lifted = (line + torch.tensor([0.0, 0.25, 0.0])).flip(0)
    assert chamfer(lifted[None], line[None]).tolist() == pytest.approx([0.25])
    # Every true point is hit, the predicted one beside them does not count; the other way round it does.
    more = torch.cat((line, torch.tensor([[0.0, 6.0, 0.0]])))
    assert chamfer(more[None], line[None]).tolist() == [0.0]
    assert chamfer(line[None], more[None]).tolist() == pytest.approx([1.0])


def test_chamfer_distance_thins_many_true_points() -> None:
    target = torch.rand(1, MOST_POINTS + 1, 3, generator=torch.Generator().manual_seed(0))
    shifted = target + torch.tensor([0.0, 0.0, 7.0])
    near = torch.cdist(target[0, ::2], shifted[0]).amin(1).mean()
    assert chamfer(shifted, target).item() == pytest.approx(near.item(), rel=1e-5)


def test_track_error_is_in_scene_units() -> None:
    target = torch.zeros(1, 4, 3)
    prediction = target.clone()
    prediction[0, 0] = torch.tensor([3.0, 0.0, 4.0])
    assert track_error(prediction, target).tolist() == pytest.approx([1.25])


def test_mask_iou_of_shifted_squares() -> None:
    target = torch.zeros(3, 8, 8)
    target[:2, 2:6, 2:6] = 1.0
    prediction = target.roll(2, dims=2)
    prediction[1] = 0.4  # less than half opaque
    found = mask_iou(prediction, target)
    assert found[:2].tolist() == pytest.approx([8 / 24, 0.0])
    assert math.isnan(found[2])


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
