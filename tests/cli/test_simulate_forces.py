"""Forces and sessions: files are written, replays are the same, wrong words are named, a thousand steps stay sound."""

import json
import random
from pathlib import Path

import pytest
import torch
from msgspec.structs import replace

from gausim.cli import simulate
from gausim.compose.live import ENERGY_ROOM, open_interaction
from gausim.core import DataError
from gausim.interaction import session as do
from gausim.interaction import words as _force_words
from gausim.interaction.interaction import Interaction
from gausim.interaction.replay import replay
from gausim.interaction.selections import Ball, Kernels, Unit, Whole
from gausim.interaction.session import Event, Force, Impulse, load_session, save_session
from gausim.io.trajectory import load_trajectory
from gausim.io.video import read_video
from gausim.ops.covariance import covariance_from_scales


def same(a: Path, b: Path) -> bool:
    first, second = load_trajectory(a), load_trajectory(b)
    names = ("positions", "deformation_gradients", "rotations")
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in names)


def test_forces_write_files_and_their_session_replays_them(played, tmp_path: Path, capsys) -> None:
    words = ["--force", "on=tip", "weights=3", "direction=x", "at=2", "frames=4", "--wind", "weights=0.5",
             "direction=0,1,0", "gusts=0.5", "--pin", "on=kernels:3", "at=6"]  # fmt: skip
    options = ["--frames", "8", "--cameras", "cam_1", "--background", "white"]
    assert simulate.main([str(played.run_dir), *words, *options, "--gif", "--out", str(tmp_path / "a")]) == 0
    folder = tmp_path / "a" / "toy" / "forces"
    names = {"trajectory.safetensors", "session.json", "cam_1.mp4", "cam_1.gif", "cam_1_sheet.png"}
    assert {p.name for p in folder.iterdir()} == names
    session = load_session(folder / "session.json")
    assert [e.at for e in session.entries] == [0, 2, 6] and session.steps == 7 and session.fps == 24.0
    event = json.loads((folder / "session.json").read_text())["events"][1]  # people read and edit it
    assert event["do"] == "force" and event["weights"] == 3.0 and event["on"]["radius"] == 0.15
    assert session.made_with.run == "demo/seed_0" and session.made_with.initial == "rest"
    trajectory = load_trajectory(folder / "trajectory.safetensors")
    scene = played.module.model.scenes[0]
    moved = (trajectory.positions - scene.means).norm(dim=-1)
    assert trajectory.frames == 8 and float(moved[5].max()) > 1e-3
    assert float(moved[:, scene.pinned].max()) == 0
    assert torch.equal(trajectory.positions[6:, 3], trajectory.positions[6, 3].expand(2, 3))
    printed = capsys.readouterr().out
    assert "what is pinned moved by 0." in printed and f"videos: {folder.as_uri()}\nnext: gausim view" in printed
    assert len(printed.splitlines()) <= 6
    shown = list(read_video(folder / "cam_1.mp4"))
    assert len(shown) == 8 and (shown[3] != shown[0]).mean() > 0.01

    again = [str(played.run_dir), "--session", str(folder / "session.json"), "--cameras", "cam_1"]
    assert simulate.main([*again, "--out", str(tmp_path / "b")]) == 0
    assert "warning" not in capsys.readouterr().err
    assert same(folder / "trajectory.safetensors", tmp_path / "b" / "toy" / "session" / "trajectory.safetensors")
    assert simulate.main([*again, "--frames", "3", "--out", str(tmp_path / "c")]) == 0
    short = load_trajectory(tmp_path / "c" / "toy" / "session" / "trajectory.safetensors")
    assert torch.equal(short.positions, trajectory.positions[:3])


def test_an_initial_state_and_a_changed_model(played, tmp_path: Path, capsys) -> None:
    words = ["--gravity", "weights=1", "direction=-z", "--sequences", "seq_001", "--frames", "4", "--cameras", "cam_0"]
    assert simulate.main([str(played.run_dir), *words, "--out", str(tmp_path)]) == 0
    path = tmp_path / "toy" / "forces" / "session.json"
    session = load_session(path)
    assert session.made_with.initial == "seq_001"
    other = replace(session, made_with=replace(session.made_with, model_hash="0", run="elsewhere/seed_3"))
    save_session(other, tmp_path / "other.json")
    replayed = [str(played.run_dir), "--session", str(tmp_path / "other.json"), "--cameras", "cam_0"]
    replayed += ["--out", str(tmp_path)]
    assert simulate.main(replayed) == 0
    assert "another method or training (run 'elsewhere/seed_3')" in capsys.readouterr().err
    folder = tmp_path / "toy"
    assert same(folder / "forces" / "trajectory.safetensors", folder / "other" / "trajectory.safetensors")
    save_session(replace(session, made_with=replace(session.made_with, scene_hash="0")), tmp_path / "other.json")
    with pytest.raises(DataError, match="other.json: it is of another scene"):
        simulate.main(replayed)


def test_parts_and_directions(played) -> None:
    scene = played.module.model.scenes[0]
    entry = _force_words.entry_of("force", ["weights=2", "direction=-y", "at=3"], scene)
    assert entry.at == 3 and entry.event == Force(Whole(), (0.0, -1.0, 0.0), 2.0)
    assert _force_words.parse_part("unit:1/7", scene) == Unit(1, 7)
    assert _force_words.parse_part("kernels:0-2,5", scene) == Kernels((0, 1, 2, 5))
    assert _force_words.parse_part("ball:1,2,3,0.5", scene) == Ball((1.0, 2.0, 3.0), 0.5)
    tip = _force_words.parse_part("tip:0.2", scene)
    assert tip.radius == 0.2 and tip.centre[2] == pytest.approx(1.05)
    impulse = _force_words.entry_of("impulse", ["weight_seconds=.1", "direction=1,2,-3"], scene).event
    assert impulse == Impulse(Whole(), (1.0, 2.0, -3.0), 0.1)


def random_event(r: random.Random, live: Interaction) -> Event:
    scene = live.scene
    kernel = r.choice((scene.simulated & ~scene.pinned).nonzero()[:, 0].tolist())
    ball = Ball(tuple(scene.means[kernel].tolist()), r.choice([0.1, 0.3]))
    part = r.choice([ball, Unit(1, int(live.units[0][kernel])), Whole()])
    direction = (r.gauss(0, 1), r.gauss(0, 1), r.gauss(0, 1))
    size = live.most_force * r.choice([1.0, r.random()])
    kinds = {
        "force": Force(part, direction, size, frames=r.choice([1, 6, 40]), name=str(r.randrange(3))),
        "impulse": Impulse(part, direction, size / live.fps * (1 - 1e-9)),
        "wind": do.Wind(direction, r.choice([0.0, size]), gusts=r.random()),
        "gravity": do.Gravity(direction, r.choice([0.0, size])),
        "pin": do.Pin(ball), "unpin": do.Unpin(), "release": do.Release(),
    }  # fmt: skip
    return kinds[r.choice([*kinds, "force", "force"])]


@pytest.mark.slow
def test_a_thousand_steps_of_random_forces(played) -> None:
    live = open_interaction(played, keep=None)
    scene, r = live.scene, random.Random(0)
    held = scene.pinned | ~scene.simulated
    rest = covariance_from_scales(scene.log_scales.double(), scene.quats.double())
    for _ in range(1000):
        for _ in range(r.choice([0, 0, 1, 2])):
            live.act(random_event(r, live))
        before, pinned = live.frame.positions, live.held.clone()
        frame = live.step()
        assert torch.isfinite(frame.positions).all() and torch.isfinite(frame.rotations).all()
        gradient = frame.deformation_gradients.double()[live.unit_of_kernel]
        assert float(torch.linalg.eigvalsh(gradient @ rest @ gradient.mT).min()) > 0
        assert torch.equal(frame.positions[held], scene.means[held])
        assert torch.equal(frame.positions[pinned], before[pinned])
    recorded, session = live.trajectory(), live.session()
    assert len(session.entries) > 500
    moved = (recorded.positions - scene.means).norm(dim=-1).amax(1) / scene.diagonal
    assert 0.02 < float(moved.max()) < 2
    start = replace(session, steps=100, entries=tuple(e for e in session.entries if e.at < 100))
    again = replay(open_interaction(played), start)
    assert torch.equal(again.positions, recorded.positions[:101])
    assert torch.equal(again.deformation_gradients, recorded.deformation_gradients[:101])
    ceiling = live._dynamics.energy_ceiling
    assert ceiling is not None and ceiling > 0 and ENERGY_ROOM > 1
