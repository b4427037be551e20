"""Synchronisation of cameras: a regular swing in few frames is no fault, a late camera is."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import toy_object
from helpers.plain import cameras_at, plain_scene

from gausim.core import Trajectory
from gausim.data.objects import ObjectData
from gausim.doctor.clock import find_clock_faults
from gausim.doctor.evidence import Evidence, gather

# Direction of the swing in each sequence, and the phase of the one across it.
SWINGS = {"seq_000": (0.3, 0.0), "seq_001": (1.4, 0.9), "seq_002": (2.3, 1.7)}
# As many frames as training sees; part of the period of the swing.
FRAMES, OMEGA = 16, 0.45


class Circling(toy_object.ToyObject):
    """A trunk whose top goes round an ellipse of a width, again and again."""

    width = 0.03

    def truth(self, sequence: str, frames: int | None = None) -> Trajectory:
        angle, phase = SWINGS[sequence]
        t = torch.arange(frames or self.frames) * OMEGA
        along, across = 0.12 * t.sin(), self.width * ((t + phase).sin() - math.sin(phase))
        turned = torch.stack((math.cos(angle) * along - math.sin(angle) * across,
                              math.sin(angle) * along + math.cos(angle) * across, 0 * t), 1)  # fmt: skip
        moved = self.scene.means + turned[:, None] * self.scene.means[:, 2:].square()
        identity = torch.eye(3).expand(len(t), 1, 3, 3)
        return Trajectory(moved, identity, identity, torch.zeros(self.scene.count, dtype=torch.long), self.fps)


def evidence(folder: Path, width: float) -> Evidence:
    generator = torch.Generator().manual_seed(0)
    means = torch.cartesian_prod(torch.tensor([-0.2, 0.0, 0.2]), torch.tensor([-0.15, 0.1]), torch.linspace(0, 1.2, 7))
    scene = plain_scene(
        means, log_scale=math.log(0.08), opacity=4.0, sh=2 * torch.rand(len(means), 1, 3, generator=generator) - 1,
        pinned=means[:, 2] < 0.1, name="circling",
    )  # fmt: skip
    places = ((0.0, 1.4), (1.5, 1.9), (-0.9, 0.8), (2.6, 1.2))
    eyes = torch.tensor([[4 * math.sin(angle), -4 * math.cos(angle), height] for angle, height in places])
    names = tuple(f"cam_{v}" for v in range(len(places)))
    cameras = cameras_at(eyes, (0.1, 0.1, 0.6), focal=110.0, size=64, names=names)
    toy = Circling(folder, scene, FRAMES + 4, FRAMES, amplitudes=dict.fromkeys(SWINGS, 1.0), cameras=cameras)
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
