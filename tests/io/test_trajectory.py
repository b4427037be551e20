from dataclasses import replace

import torch
from helpers.plain import unit_motion, unit_scene

from gausim.core import Trajectory
from gausim.io.trajectory import load_trajectory, save_trajectory


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
