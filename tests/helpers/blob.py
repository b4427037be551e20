"""A hand-made object directory, small enough to rebuild for every test that spoils it."""

import math
from pathlib import Path

import numpy as np
import torch

from gausim.core import Cameras
from gausim.data.images import write_rgba
from gausim.io.transforms import write_transforms
from helpers import toy_object
from helpers.plain import cameras_at, edit_json, plain_scene

VIEWS = ("cam_0", "cam_1", "cam_2")
FRAMES, SEQUENCES, WIDTH, HEIGHT, POINTS = 20, 3, 8, 6, 5


def ring_of_cameras(names: tuple[str, ...], *, width: int = WIDTH, height: int = HEIGHT) -> Cameras:
    """Cameras that stand around the z axis and look at the origin, level."""
    angles = 2 * math.pi * torch.arange(len(names)) / max(3, len(names))
    eyes = 4 * torch.stack((angles.cos(), angles.sin(), 0 * angles), 1)
    k = torch.tensor([[9.0, 0.0, width / 2], [0.0, 9.5, height / 2], [0.0, 0.0, 1.0]])
    viewmats = cameras_at(eyes, (0.0, 0.0, 0.0), focal=9.0, size=width, names=names).viewmats
    return Cameras(viewmats, k.expand(len(names), 3, 3).clone(), width, height, names)


def frame_pixels(sequence: int, view: int, frame: int) -> np.ndarray:
    """RGBA whose four channels tell sequence, view and frame."""
    pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    pixels[...] = (10 * sequence + 1, 20 * view + 2, frame + 3, 255)
    pixels[0, 0] = (200, 100, 50, 0)
    return pixels


class Blob(toy_object.ToyObject):
    """Its points move by 1/64 per frame along every axis."""

    def images(self, sequence: str) -> torch.Tensor:
        number = int(sequence.removeprefix("seq_"))
        frames = [[frame_pixels(number, v, f) for v in range(len(VIEWS))] for f in range(FRAMES)]
        return torch.from_numpy(np.array(frames))

    def displacement(self, sequence: str) -> torch.Tensor:
        return (torch.arange(FRAMES) / 64).half()[:, None, None].expand(FRAMES, POINTS, 3)


def make_object(root: Path, *, name: str = "blob", sequences: int = SEQUENCES) -> Path:
    """Writes the whole directory."""
    means = torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(0))
    scene = plain_scene(means, pinned=torch.arange(POINTS) == 0, name=name)
    names = dict.fromkeys((f"seq_{s:03d}" for s in range(sequences)), 0.0)
    cameras = ring_of_cameras(VIEWS)
    toy_object.write_object(Blob(root, scene, FRAMES, first_unseen=16, amplitudes=names, cameras=cameras))
    edit_json(root / "dataset.json", lambda facts: facts.update(object_diagonal=1.5))
    stills = tuple(f"{i:04d}" for i in range(12))
    (root / "static" / "images").mkdir(parents=True)
    for i, still in enumerate(stills):
        write_rgba(root / "static" / "images" / f"{still}.png", frame_pixels(0, 0, i))
    entries = [{"file_path": f"images/{still}.png"} for still in stills]
    write_transforms(root / "static" / "transforms.json", ring_of_cameras(stills), entries)
    return root
