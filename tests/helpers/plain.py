"""What many tests make alike: scenes of round kernels, cameras that look at a place, changed JSON, pickled calls."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten

from gausim.core import Cameras, GaussianScene
from gausim.ops.orbit import look_at


def plain_scene(
    means: Tensor, *, log_scale: float = -3.0, opacity: float = 0.0, sh: Tensor | None = None, **fields: Any
) -> GaussianScene:
    """Round kernels of one size and opacity; grey unless ``sh`` are given."""
    count = len(means)
    made = GaussianScene.create(
        means=means,
        log_scales=torch.full((count, 3), log_scale),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4).clone(),
        opacity_logits=torch.full((count,), opacity),
        sh=torch.zeros(count, 1, 3) if sh is None else sh,
    )
    return replace(made, **fields).validated()


def cameras_at(eyes: Tensor, at: Sequence[float], *, focal: float, size: int, names: Sequence[str]) -> Cameras:
    """Square cameras at some places, z up, that look at another."""
    viewmats = torch.stack([look_at(eye, torch.tensor(at), torch.tensor([0.0, 0.0, 1.0])) for eye in eyes])
    k = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Cameras(viewmats, k.repeat(len(eyes), 1, 1), size, size, tuple(names))


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
