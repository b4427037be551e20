"""A body that sways about its pinned foot before a ring of cameras: what tests of the doctor share."""

import math

import torch
from torch import Tensor

from gausim.core import Cameras, GaussianScene, Trajectory
from helpers import toy_object
from helpers.plain import cameras_at, plain_scene

SIZE, OMEGA = 64, 0.7
VIEWS = ("cam_0", "cam_1", "cam_2", "cam_3")
# Direction and phase of the two swings of each sequence.
SWINGS = {"seq_000": (0.3, 0.0), "seq_001": (1.4, 0.9), "seq_002": (2.3, 1.7), "seq_003": (-0.8, 2.4)}


class Swaying(toy_object.ToyObject):
    """Sways about its pinned foot in two directions that come and go."""

    def swings(self, t: Tensor, phase: float) -> tuple[Tensor, Tensor]:
        """Shifts of the height 1 along the sequence's direction and across it, at frames t."""
        return torch.sin(OMEGA * t) * (1 + 0.6 * torch.sin(0.23 * t + phase)) * 0.12, torch.sin(OMEGA * 1.31 * t) * 0.06

    def truth(self, sequence: str, frames: int | None = None) -> Trajectory:
        count = frames or self.frames
        direction, phase = SWINGS[sequence]
        wave, cross = self.swings(torch.arange(count), phase)
        height = self.scene.means[:, 2] ** 2
        shift = torch.zeros(count, self.scene.count, 3)
        shift[:, :, 0] = (math.cos(direction) * wave - math.sin(direction) * cross)[:, None] * height
        shift[:, :, 1] = (math.sin(direction) * wave + math.cos(direction) * cross)[:, None] * height
        identity = torch.eye(3).expand(count, 1, 3, 3)
        return Trajectory(self.scene.means + shift, identity, identity,
                          torch.zeros(self.scene.count, dtype=torch.long), self.fps)  # fmt: skip


def body() -> GaussianScene:
    trunk = torch.cartesian_prod(torch.tensor([-0.2, 0.0, 0.2]), torch.tensor([-0.15, 0.1]), torch.linspace(0, 1.2, 7))
    arm = torch.stack((torch.linspace(0.3, 0.9, 6), torch.linspace(0.1, 0.5, 6), torch.linspace(0.7, 1.1, 6)), 1)
    means = torch.cat((trunk, arm))
    generator = torch.Generator().manual_seed(0)
    return plain_scene(
        means, log_scale=math.log(0.08), opacity=4.0, sh=2 * torch.rand(len(means), 1, 3, generator=generator) - 1,
        pinned=means[:, 2] < 0.1, name="swaying",
    )  # fmt: skip


def ring() -> Cameras:
    places = ((0.0, 1.4), (1.5, 1.9), (-0.9, 0.8), (2.6, 1.2))
    eyes = torch.tensor([[4 * math.sin(angle), -4 * math.cos(angle), height] for angle, height in places])
    return cameras_at(eyes, (0.1, 0.1, 0.6), focal=110.0, size=SIZE, names=VIEWS)
