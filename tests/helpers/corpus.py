"""A small corpus of swaying beams with known motion and material."""

import math
from pathlib import Path

import msgspec
import torch
from safetensors.torch import save_file

from gausim.data.corpus import MANIFEST, SCHEMA, BodyRecord, Manifest, PushRecord

FPS, FRAMES, SEQUENCES = 24.0, 24, 2


def write_corpus(folder: Path, bodies: int = 3) -> Path:
    """Upright beams swaying with periods of 10, 12, ... frames, two to a shard; the lower halves are twice as stiff."""
    folder.mkdir(parents=True, exist_ok=True)
    shards, records = dict[str, dict[str, torch.Tensor]](), []
    steps = torch.arange(5.0)
    rest = torch.cartesian_prod(steps[:3], steps[:3], torch.arange(9.0)) / 8
    pinned, stiff = rest[:, 2] == 0, torch.where(rest[:, 2] < 0.5, 2.0, 1.0)
    diagonal = float((rest.amax(0) - rest.amin(0)).norm())
    for body in range(bodies):
        name, shard, period = f"beam{body}", f"shard_{body // 2:05d}.safetensors", 10.0 + 2 * body
        swing = 0.05 * torch.cos(2 * math.pi / period * torch.arange(float(FRAMES)))
        moved = torch.zeros(SEQUENCES, FRAMES, len(rest), 3)
        for axis in range(SEQUENCES):
            moved[axis, :, :, axis] = swing[:, None] * rest[:, 2].square()
        values = {
            "rest": rest, "pinned": pinned, "scale": torch.full((len(rest),), 0.06), "stiffness": 1e4 * stiff,
            "density": 1e3 * stiff, "damping": torch.full((len(rest),), 0.5), "displacement": (moved / diagonal).half(),
        }  # fmt: skip
        shards.setdefault(shard, {}).update({f"{name}.{field}": value.clone() for field, value in values.items()})
        push = PushRecord("poke", "release", (1.0, 0.0, 0.0), float(moved.norm(dim=-1).max()) / diagonal)
        records.append(
            BodyRecord(
                name, shard, "slab", "bottom", "split", 2.0, len(rest), SEQUENCES, FRAMES,
                FPS, diagonal, 0.3, period, push.swing, (push,) * SEQUENCES, 0,
            )
        )  # fmt: skip
    for shard, tensors in shards.items():
        save_file(tensors, folder / shard)
    (folder / MANIFEST).write_bytes(msgspec.json.encode(Manifest(SCHEMA, 0, {}, 0, tuple(records))))
    return folder
