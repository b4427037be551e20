"""Frames are written as numbered PLY files, whole, and never over others."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.plain import FIELDS, random_scene, unit_motion, unit_scene

from gausim.core import DataError, Trajectory
from gausim.io.ply import load_scene
from gausim.io.ply_sequence import save_ply_sequence
from gausim.io.trajectory import load_trajectory, save_trajectory


def test_every_frame_is_written_exactly_with_masks_and_rate(tmp_path: Path) -> None:
    made = [random_scene(20, seed=number) for number in range(12)]
    written = save_ply_sequence(tmp_path / "s", "cup_2", iter(made), 23.976)
    assert [p.name for p in written][::11] == ["cup_2_0001.ply", "cup_2_0012.ply"]
    beside = {p.name for p in (tmp_path / "s").iterdir()} - {p.name for p in written}
    assert beside == {"cup_2.masks.npz", "cup_2.json"}
    assert json.loads((tmp_path / "s" / "cup_2.json").read_text()) == {"fps": 23.976, "frames": 12}
    for scene, path in zip(made, written, strict=True):
        read = load_scene(path, masks=tmp_path / "s" / "cup_2.masks.npz")
        assert all(torch.equal(getattr(scene, n), getattr(read, n)) for n in FIELDS) and read.volume_scale == 37.5


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no frames to write"):
        save_ply_sequence(tmp_path / "e", "a", [], 24.0)
    save_ply_sequence(tmp_path / "s", "a", [random_scene(20)], 24.0)
    with pytest.raises(DataError, match="holds 'a_0001.ply' already"):
        save_ply_sequence(tmp_path / "s", "a", [random_scene(20)], 24.0)
    assert save_ply_sequence(tmp_path / "s", "b", [random_scene(20)], 24.0)


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
