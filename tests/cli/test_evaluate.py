"""`gausim evaluate` and `gausim simulate` of a run that knows the true motion."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import toy_object
from helpers.played import stand_in

from gausim.cli import evaluate, evaluate_run, simulate, simulate_run
from gausim.compose import build
from gausim.core import SimState
from gausim.io.trajectory import load_trajectory
from gausim.io.video import read_video


@pytest.fixture
def run(toy, tmp_path, monkeypatch):
    """A run whose model knows the toy's formula and reads the sequence from its initial state."""
    toy = toy_object.ToyObject(toy, toy_object.toy_scene())
    names = list(toy.amplitudes)
    initial = SimpleNamespace(state=lambda sequence: SimState(toy.scene.means, toy.scene.means + sequence))

    def rollout(state, steps):
        return toy.truth(names[round(float((state.previous - toy.scene.means).mean()))], frames=steps + 1)

    model = SimpleNamespace(scenes=[toy.scene], dynamics=lambda scene_id: SimpleNamespace(rollout=rollout))

    def predict(sequence, steps):
        return rollout(SimState(toy.scene.means, initial.state(sequence).previous), steps)

    loaded = stand_in(tmp_path / "run", toy.root, model=model, initial_states=initial, predict=predict)
    for home in (evaluate_run, simulate_run, build):
        monkeypatch.setattr(home, "load_run", lambda path, **_: loaded)
    return loaded


def test_whole_evaluation(run, capsys):
    assert evaluate.main([str(run.run_dir)]) == 0
    captured = capsys.readouterr()
    folder = run.run_dir / "evaluation"
    assert "`gausim prepare lpips` gets them" in (folder / "table.md").read_text()
    lines = captured.out.splitlines()
    assert lines[0].startswith("toy: Unseen frames 8–19: 3D error 0.00 of the static prediction's")
    assert lines[1] == f"tables: {(folder / 'table.md').as_uri()}" and lines[2] == f"next: gausim report {run.run_dir}"
    assert len(lines) == 4 and "not finished" not in captured.err
    names = {p.name for p in folder.iterdir()}
    assert names == {"metrics.json", "metrics.npz", "film_toy.mp4", "table.md", "errors_toy.png"}
    summary = json.loads((folder / "metrics.json").read_text())
    expected = {"name": "toy", "seed": 5, "views": "all", "finished": True, "epoch": 3, "updates": 40}
    assert summary["run"] == expected
    row = {(e[4], e[5]): e[7] for e in summary["table"] if (e[0], e[3]) == ("gausim", "unseen")}
    assert row["points", "error_3d_ratio"] < 1e-3 and row["heldout", "l2"] < 3


def test_a_part_does_not_overwrite_the_whole(run, capsys):
    (run.run_dir / "FINISHED").unlink()
    assert evaluate.main([str(run.run_dir), "--sequences", "seq_001", "--cameras", "heldout", "--json"]) == 0
    told = capsys.readouterr()
    printed = json.loads(told.out)
    assert "warning" in told.err and printed["run"]["finished"] is False
    assert printed["objects"]["toy"]["sequences"] == ["seq_001"]
    assert {e[4] for e in printed["table"] if (e[0], e[3]) == ("static", "seen")} == {"heldout", "points"}
    assert not (run.run_dir / "evaluation" / "metrics.json").exists()
    assert (run.run_dir / "evaluation" / "partial" / "metrics.json").is_file()


def test_a_sequence_gives_all_files(run, capsys):
    assert simulate.main([str(run.run_dir), "--gif"]) == 0
    folder = run.run_dir / "simulation" / "toy" / "seq_000"
    views = [f"{view}{end}" for view in ("cam_0", "cam_2") for end in (".gif", ".mp4", "_sheet.png")]
    assert {p.name for p in folder.iterdir()} == {*views, "errors.png", "trajectory.safetensors"}
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("toy seq_000: Unseen frames 8–19: 3D error 0.00")
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
    options = ["--sequences", "all", "--cameras", "cam_1", "--frames", "26", "--out", str(run.run_dir / "out")]
    assert simulate.main([str(run.run_dir), *options, "--background", "white", "--brighten", "1.2"]) == 0
    assert {p.name for p in (run.run_dir / "out" / "toy").iterdir()} == {"seq_000", "seq_001"}
    folder = run.run_dir / "out" / "toy" / "seq_001"
    frames = list(read_video(folder / "cam_1.mp4"))
    assert len(frames) == 26 and load_trajectory(folder / "trajectory.safetensors").frames == 26
    assert frames[5][40, 20].min() > 240 > 40 > frames[25][40, 20].max()  # beyond the recording there is no truth
