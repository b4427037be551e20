"""What many tests make alike: scenes, motions, cameras that look at a place, pictures, changed JSON, pickled calls."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten

from gausim.core import Cameras, GaussianScene, Trajectory
from gausim.ops.deformation import polar_rotation
from gausim.ops.orbit import look_at

FIELDS = ("means", "log_scales", "quats", "opacity_logits", "sh", "simulated", "pinned", "foreground")


def plain_scene(
    means: Tensor, *, log_scale: float = -3.0, opacity: float = 0.0, sh: Tensor | None = None, **fields: Any
) -> GaussianScene:
    """Round kernels of one size and opacity; grey unless ``sh`` are given."""
    count = len(means)
    made = GaussianScene.create(
        means=means, log_scales=torch.full((count, 3), log_scale),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4).clone(), opacity_logits=torch.full((count,), opacity),
        sh=torch.zeros(count, 1, 3) if sh is None else sh,
    )  # fmt: skip
    return replace(made, **fields).validated()


def random_scene(count: int = 7, degree: int = 1, *, seed: int = 0, masks: bool = True) -> GaussianScene:
    g, number = torch.Generator().manual_seed(seed), torch.arange(count)
    chosen = {"simulated": number < count - 1, "pinned": number < 2, "foreground": number >= 2} if masks else {}
    return GaussianScene.create(
        means=torch.randn(count, 3, generator=g), log_scales=torch.randn(count, 3, generator=g) * 0.5 - 3,
        quats=torch.randn(count, 4, generator=g), opacity_logits=torch.randn(count, generator=g) * 3,
        sh=torch.randn(count, (degree + 1) ** 2, 3, generator=g), volume_scale=37.5, name="scene", **chosen,
    )  # fmt: skip


def unit_scene(count: int = 60, degree: int = 2) -> GaussianScene:
    scene = random_scene(count, degree)
    return replace(scene, pinned=torch.arange(count) < 5, foreground=torch.arange(count) % 7 > 0, volume_scale=3.5)


def unit_motion(scene: GaussianScene, frames: int = 5, units: int = 6, travel: float = 0.0) -> Trajectory:
    """Kernels 0..4 are a unit that stands still, unless all ``travel`` so far per frame [scene units]."""
    torch.manual_seed(1)
    unit = 1 + torch.arange(scene.count) % (units - 1)
    unit[:5] = 0
    gradients = torch.eye(3) + 0.3 * torch.rand(frames, units, 3, 3)
    moved = 0.4 * torch.rand(frames, units, 3) + travel * torch.arange(frames)[:, None, None]
    gradients[:, 0], gradients[0], moved[0] = torch.eye(3), torch.eye(3), 0
    if not travel:
        moved[:, 0] = 0
    centres = torch.stack([scene.means[unit == u].mean(0) for u in range(units)])
    offset = scene.means - centres[unit]
    positions = (centres + moved)[:, unit] + (gradients[:, unit] @ offset[..., None])[..., 0]
    return Trajectory(positions, gradients, polar_rotation(gradients), unit, 30.0)


def cameras_at(eyes: Tensor, at: Sequence[float], *, focal: float, size: int, names: Sequence[str]) -> Cameras:
    """Square cameras at some places, z up, that look at another."""
    viewmats = torch.stack([look_at(eye, torch.tensor(at), torch.tensor([0.0, 0.0, 1.0])) for eye in eyes])
    k = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Cameras(viewmats, k.repeat(len(eyes), 1, 1), size, size, tuple(names))


def pair(height: int = 48, width: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    """A picture of waves, and the same shifted and duller: (prediction, target)."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    waves = [0.5 + 0.5 * np.sin(0.31 * x + 0.2 * y), 0.5 + 0.5 * np.sin(0.17 * x - 0.4 * y + 1),
             0.5 + 0.4 * np.cos(0.05 * x * y / 8)]  # fmt: skip
    target = np.stack(waves, -1)
    prediction = np.clip(0.85 * np.roll(target, 3, 1) + 0.05, 0, 1)
    return torch.tensor(prediction, dtype=torch.float32)[None], torch.tensor(target, dtype=torch.float32)[None]


def contents(folder: Path) -> dict[str, bytes]:
    """The bytes of all files in a folder, by name."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def edit_json(path: Path, change: Callable[[dict], object]) -> None:
    """Changes the JSON object in a file in its place."""
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def digest(content: Any) -> str:
    """SHA-256 of nested containers of tensors and plain values: bytes, types, shapes and order enter."""
    leaves, layout = tree_flatten(content)
    running = hashlib.sha256(str(layout).encode())
    for leaf in leaves:
        if isinstance(leaf, Tensor):
            running.update(f"{leaf.dtype} {tuple(leaf.shape)}".encode() + leaf.detach().cpu().numpy().tobytes())
        else:
            assert leaf is None or type(leaf) in (bool, int, float, str, bytes), type(leaf)
            running.update(repr(leaf).encode())
    return running.hexdigest()


class Call:
    """Is pickled as a call, which a careless reader would run."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple:
        return self.call
