"""A tiny object on disk whose motion is known by formula: a block of kernels that sways about its pinned foot."""

import json
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gausim.core import Cameras, GaussianScene, Trajectory
from gausim.data.images import write_rgba
from gausim.io.ply import save_scene
from gausim.io.transforms import write_transforms
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import draw
from helpers.plain import cameras_at, edit_json, plain_scene

AMPLITUDES = {"seq_000": 0.4, "seq_001": -0.25}
OMEGA, SIZE, VIEWS = 0.45, 32, ("cam_0", "cam_1", "cam_2")


@dataclass
class ToyObject:
    root: Path
    scene: GaussianScene
    frames: int = 20
    first_unseen: int = 8
    fps: float = 24.0
    amplitudes: dict[str, float] = field(default_factory=lambda: dict(AMPLITUDES))
    cameras: Cameras | None = None

    @property
    def views(self) -> Cameras:
        return self.cameras if self.cameras is not None else cameras()

    def truth(self, sequence: str, frames: int | None = None) -> Trajectory:
        count = frames or self.frames
        wave = torch.sin(OMEGA * torch.arange(count)) * self.amplitudes[sequence]
        shift = torch.zeros(count, self.scene.count, 3)
        shift[:, :, 0] = wave[:, None] * self.scene.means[:, 2] ** 2
        identity = torch.eye(3).expand(count, 1, 3, 3)
        return Trajectory(self.scene.means + shift, identity, identity,
                          torch.zeros(self.scene.count, dtype=torch.long), self.fps)  # fmt: skip

    def images(self, sequence: str) -> Tensor:
        """Frames of a sequence from all views, RGBA."""
        return rgba(self.scene, self.truth(sequence), self.views)

    def displacement(self, sequence: str) -> Tensor:
        return self.truth(sequence).positions - self.scene.means


def toy_scene() -> GaussianScene:
    axis = torch.tensor([-0.3, 0.0, 0.3])
    means = torch.cartesian_prod(axis, axis, torch.tensor([0.0, 0.35, 0.7, 1.05]))
    generator = torch.Generator().manual_seed(0)
    return plain_scene(
        means, log_scale=math.log(0.12), opacity=2.0, sh=torch.rand(len(means), 1, 3, generator=generator),
        pinned=means[:, 2] < 0.1, name="toy",
    )  # fmt: skip


def cameras() -> Cameras:
    eyes = torch.tensor([[4 * math.sin(angle), -4 * math.cos(angle), 0.9] for angle in (0.0, 1.2, -0.9)])
    return cameras_at(eyes, (0.0, 0.0, 0.5), focal=56.0, size=SIZE, names=VIEWS)


def write_toy_object(root: Path, *, frames: int = 20) -> ToyObject:
    return write_object(ToyObject(root, toy_scene(), frames=frames))


def write_object(toy: ToyObject) -> ToyObject:
    root, names = toy.root, toy.views.names
    root.mkdir(parents=True)
    facts = {"name": toy.scene.name, "fps": toy.fps, "views": names, "train_views": names[:2],
             "heldout_views": names[2:], "train_frames": [0, toy.first_unseen]}  # fmt: skip
    (root / "dataset.json").write_text(json.dumps(facts))
    save_scene(toy.scene, root / "scene.ply")
    np.savez(root / "rest_points.npz", points=toy.scene.means.numpy())
    for name in toy.amplitudes:
        _write_sequence(toy, name)
    return toy


def surround(root: Path, **facts: object) -> None:
    """States surroundings of a written object."""
    edit_json(root / "dataset.json", lambda data: data.update(facts))


def hold(root: Path, points: Tensor, way: Tensor, *, grip: float = 0.5) -> None:
    """Has a hand hold a written object near points (C, 3) and go along a way (F, 3), in every sequence."""
    surround(root, grip=grip)
    for sequence in (root / "sequences").iterdir():
        moved = (points + way[:, None]).numpy()
        np.savez(sequence / "hands.npz", points=moved, hand=np.zeros(len(points), np.int64))


def _write_sequence(toy: ToyObject, name: str) -> None:
    folder, images, entries = toy.root / "sequences" / name, toy.images(name), []
    for v, view in enumerate(toy.views.names):
        (folder / view).mkdir(parents=True)
        for f in range(toy.frames):
            write_rgba(folder / view / f"{f:04d}.png", images[f, v])
            entries.append({"file_path": f"{view}/{f:04d}.png", "camera": view, "frame": f})
    every = toy.views.select([v for v in range(len(toy.views.names)) for _ in range(toy.frames)])
    write_transforms(folder / "transforms.json", every, entries, fps=toy.fps)
    np.savez(folder / "ground_truth.npz", displacement=toy.displacement(name).numpy())


def rgba(scene: GaussianScene, trajectory: Trajectory, views: Cameras | None = None) -> Tensor:
    drawn = draw(CpuRenderer(threads=1), scene, trajectory.positions, trajectory.deformation_gradients,
                 trajectory.rotations, trajectory.unit_of_kernel, views or cameras())  # fmt: skip
    straight = drawn.rgb / drawn.alpha.clamp_min(1e-6)[..., None]
    return (torch.cat((straight, drawn.alpha[..., None]), -1).clamp(0, 1) * 255).round().to(torch.uint8)
