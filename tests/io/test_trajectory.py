from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.unit_motions import unit_motion, unit_scene
from safetensors.torch import load_file, save_file

from gausim.core import DataError, Trajectory
from gausim.io.trajectory import FORMAT, load_trajectory, save_trajectory


def trajectory() -> Trajectory:
    return replace(unit_motion(unit_scene(), frames=4, units=3), fps=30000 / 1001)


def test_round_trip_is_bitwise(tmp_path):
    original = trajectory()
    save_trajectory(tmp_path / "a" / "t.safetensors", original, facts={"object": "bunny"})
    loaded = load_trajectory(tmp_path / "a" / "t.safetensors")
    for name in ("positions", "deformation_gradients", "rotations", "unit_of_kernel"):
        first, second = getattr(original, name), getattr(loaded, name)
        assert first.dtype == second.dtype and torch.equal(first, second)
    assert loaded.fps == original.fps
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["t.safetensors"]


def test_broken_files_name_what_is_wrong(tmp_path):
    path, head = tmp_path / "t.safetensors", {"format": FORMAT}
    with pytest.raises(DataError, match=r"t\.safetensors: no such file"):
        load_trajectory(path)
    path.write_bytes(b"half")
    with pytest.raises(DataError, match="cannot be read as safetensors"):
        load_trajectory(path)
    save_trajectory(path, trajectory())
    tensors = load_file(str(path))
    for changed, metadata, message in (
        ({}, None, "header 'format' is None"),
        ({"rotations": None}, head, "'rotations' is missing"),
        (
            {"gradients": tensors["gradients"][:-1]},
            head,
            r"'gradients' has shape \(3, 3, 3, 3\), expected \(4, 3, 3, 3\)",
        ),
        ({"unit_of_kernel": tensors["unit_of_kernel"] + 3}, head, "indices of 3 units"),
    ):
        save_file({k: v for k, v in {**tensors, **changed}.items() if v is not None}, str(path), metadata=metadata)
        with pytest.raises(DataError, match=message):
            load_trajectory(path)
