"""Synchronisation of cameras: a regular swing in few frames is no fault, a late camera is."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import toy_object
from helpers.swaying import SWINGS, Swaying, body, ring
from torch import Tensor

from gausim.data.objects import ObjectData
from gausim.doctor.clock import find_clock_faults
from gausim.doctor.evidence import Evidence, gather

# As many frames as training sees; part of the period of the swing.
FRAMES, OMEGA = 16, 0.45


class Circling(Swaying):
    """Its top goes round an ellipse of a width, again and again."""

    width = 0.0

    def swings(self, t: Tensor, phase: float) -> tuple[Tensor, Tensor]:
        return 0.12 * torch.sin(OMEGA * t), self.width * (torch.sin(OMEGA * t + phase) - math.sin(phase))


def evidence(folder: Path, width: float) -> Evidence:
    toy = Circling(folder, body(), FRAMES + 4, FRAMES, amplitudes=dict.fromkeys(SWINGS, 1.0), cameras=ring())
    toy.width = width
    toy_object.write_object(toy)
    data = ObjectData(folder)
    return gather(data, data.scene())


def shown(whole: Evidence, late: dict[int, int]) -> list[str]:
    """What is found in the first frames, with some views late by so many."""

    def cut(x: np.ndarray) -> np.ndarray:
        return np.stack([x[4 - late.get(v, 0) :, v][:FRAMES] for v in range(x.shape[1])], 1)

    watched = tuple(replace(item, rgb=cut(item.rgb), alpha=cut(item.alpha)) for item in whole.watched)
    return [finding.what for finding in find_clock_faults(replace(whole, watched=watched))]


# The second one is nearly a circle, whose phase depends on the view.
@pytest.mark.parametrize("width", [0.04, 0.1])
def test_a_regular_swing_is_in_step_and_a_late_camera_is_not(width: float, tmp_path: Path) -> None:
    whole = evidence(tmp_path / "circling", width)
    assert shown(whole, {}) == []
    (told,) = shown(whole, {1: 2})
    assert re.match("cam_1 is not synchronised: it shows the motion [23] frames later than the other cameras", told)
