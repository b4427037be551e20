from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

from gausim.cli import simulate
from gausim.core import ConfigError, DataError
from gausim.io.trajectory import load_trajectory
from gausim.io.video import read_video

run = runpy.run_path(str(Path(__file__).with_name("test_evaluate.py")))["run"]


def test_a_sequence_gives_all_files(run, capsys):
    assert simulate.main([str(run.run_dir), "--gif"]) == 0
    folder = run.run_dir / "simulation" / "toy" / "seq_000"
    views = [f"{view}{end}" for view in ("cam_0", "cam_2") for end in (".gif", ".mp4", "_sheet.png", "_slices.png")]
    assert {p.name for p in folder.iterdir()} == {*views, "errors.png", "trajectory.safetensors"}
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("toy seq_000: On frames never seen (8–19), its points are 0.00 times as far off")
    assert lines[1] == f"videos: {folder.parent.as_uri()}" and len(lines) == 4
    assert lines[3].split() == ["gausim", "simulate", str(run.run_dir), *"--force on=tip weights=3 direction=x".split()]
    frames = list(read_video(folder / "cam_2.mp4"))
    assert len(frames) == 20 and frames[0].shape[1] == 3 * 320
    # The prediction is the truth here: the first two panels agree, the error panel is dark.
    left, middle, right = np.split(frames[12][30:330].astype(int), 3, axis=1)
    assert np.abs(left - middle).mean() < 4 < left.mean() and right.mean() < 4
    saved = load_trajectory(folder / "trajectory.safetensors")
    assert saved.frames == 20 and saved.fps == 24.0
    toy_scene = run.module.model.scenes[0]
    assert torch.equal(saved.positions[0], toy_scene.means)


def test_more_frames_than_were_recorded_of_all_sequences(run):
    options = ["--sequence", "all", "--view", "cam_1", "--frames", "26", "--out", str(run.run_dir / "out")]
    assert simulate.main([str(run.run_dir), *options, "--background", "white", "--brighten", "1.2"]) == 0
    assert {p.name for p in (run.run_dir / "out" / "toy").iterdir()} == {"seq_000", "seq_001"}
    folder = run.run_dir / "out" / "toy" / "seq_001"
    frames = list(read_video(folder / "cam_1.mp4"))
    assert len(frames) == 26 and load_trajectory(folder / "trajectory.safetensors").frames == 26
    assert frames[5][40, 20].min() > 240 > 40 > frames[25][40, 20].max()  # beyond the recording there is no truth


def test_what_is_not_there_is_named(run):
    with pytest.raises(DataError, match="seq_9"):
        simulate.main([str(run.run_dir), "--sequence", "seq_9"])
    with pytest.raises(DataError, match="cam_9"):
        simulate.main([str(run.run_dir), "--view", "cam_9"])
    with pytest.raises(ConfigError, match="--background mauve"):
        simulate.main([str(run.run_dir), "--background", "mauve"])
