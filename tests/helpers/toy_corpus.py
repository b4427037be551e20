"""A corpus of made-up bodies, written without any simulator."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import save_file

from gausim.data.corpus import MANIFEST, SCHEMA

MATERIAL = ("scale", "stiffness", "density", "damping")


def write_toy_corpus(root: Path, *, bodies: int = 3, kernels: int = 40, frames: int = 6, sequences: int = 2) -> Path:
    """Bodies that swing like pendulums, two to a shard; the lowest fifth of their kernels is pinned."""
    root.mkdir(parents=True)
    records, shards = [], dict[str, dict[str, torch.Tensor]]()
    for number in range(bodies):
        name, shard = f"toy_{number:06d}", f"shard_{number // 2:05d}.safetensors"
        draw = torch.Generator().manual_seed(number)
        rest = torch.rand(kernels, 3, generator=draw)
        angle = torch.arange(1, frames + 1) * torch.arange(1, sequences + 1)[:, None] / 3
        height = (rest[:, 2] - 0.2).clamp_min(0)
        moved = 0.1 * angle.sin()[..., None, None] * height[:, None] * torch.tensor([1.0, 0.0, 0.0])
        tensors = {
            "rest": rest, "pinned": height == 0, "displacement": moved.half(),
            **{field: torch.rand(kernels, generator=draw) + 0.5 for field in MATERIAL},
        }  # fmt: skip
        shards.setdefault(shard, {}).update({f"{name}.{field}": tensor for field, tensor in tensors.items()})
        push = {"kind": "drag", "start": "impulse", "direction": [1.0, 0.0, 0.0], "swing": 0.1}
        records.append(
            {
                "name": name,
                "shard": shard,
                "shape": "toy",
                "pins": "bottom",
                "material": "smooth",
                "contrast": 3.0,
                "simulator": "none",
                "kernels": kernels,
                "sequences": sequences,
                "frames": frames,
                "fps": 24.0,
                "diagonal": float((rest.max(0).values - rest.min(0).values).norm()),
                "poisson_ratio": 0.3,
                "period": 18.8,
                "swing": 0.1,
                "pushes": [push] * sequences,
                "redrawn": 0,
            }  # fmt: skip
        )
    for shard, tensors in shards.items():
        save_file(tensors, root / shard)
    manifest = {"schema": SCHEMA, "seed": 0, "settings": {}, "redrawn": 0, "bodies": records}
    (root / MANIFEST).write_text(json.dumps(manifest))
    return root
