"""The set made by Blender: its layout, resumption, environment and processes, with stand-ins for Blender and pip."""

import io
import json
import os
import stat
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.plain import contents

from data_prep.blender import environment as blender_env
from data_prep.blender import plan as planning
from data_prep.blender.environment import BlenderError, BlenderProcess, find_blender
from data_prep.blender.meshes import Surface, make_surface, read_mesh
from data_prep.blender.plan import Pictures, Plan, action, camera
from data_prep.blender_bunny import make_set
from gausim.data.objects import ObjectData
from gausim.data.verify import verify

PLAN = Plan(
    name="box", up="z", sequences=3, frames=4, views=3, heldout=1, points=40,
    pictures=Pictures(stills=23, resolution=(20, 12), still_resolution=(16, 16), samples=1),
)  # fmt: skip
BOX = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 2) for z in (0, 3))
BOX += "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    path = tmp_path / "box.obj"
    path.write_text(BOX)
    return path


@pytest.fixture
def surface(mesh: Path) -> Surface:
    return make_surface(read_mesh(mesh), mesh, up="z", points=40, seed=0)


class FakeBlender:
    """Moves nothing, draws discs; the same for the same job. May die before a picture, or leave one out."""

    def __init__(self, *, die_at: int | None = None, skip: str = "", version: str = "4.5") -> None:
        self.die_at, self.skip, self.version, self.taken = die_at, skip, version, 0
        self.jobs: list[Mapping[str, Any]] = []

    def versions(self) -> dict[str, str]:
        return {"bpy": self.version, "numpy": "1.26", "python": "3.11"}

    def run(self, job: Mapping[str, Any], told: Callable[[str], None], stop: threading.Event) -> None:
        self.jobs.append(job)
        points = np.load(job["rest"])["gt_ids"].size
        if job["motion"] is not None and not Path(job["motion"]["file"]).is_file():
            held = io.BytesIO()
            moved = np.zeros((job["motion"]["frames"], points, 3), np.float32)
            moved[1:, :, 0] = job["motion"]["amplitude"]
            np.savez_compressed(held, displacement=moved, strength=np.float64(7))
            Path(job["motion"]["file"]).parent.mkdir(parents=True, exist_ok=True)
            Path(job["motion"]["file"]).write_bytes(held.getvalue())
        for image in job["images"]:
            path, (width, height) = Path(image["file"]), job["camera"]["size"]
            path.parent.mkdir(parents=True, exist_ok=True)
            if self.die_at is not None and self.taken >= self.die_at:
                path.with_name(f".{path.stem}.99.tmp.png").write_bytes(b"half")
                raise BlenderError("Blender gave up (exit code -9)")
            picture = np.zeros((height, width, 4), np.uint8)
            cv2.circle(picture, (width // 2, height // 2), 3, (len(self.version), image["frame"] or 0, 9, 255), -1)
            if not (self.skip and image["file"].endswith(self.skip)):
                cv2.imwrite(str(path), picture)
            self.taken += 1
            told("image")


def test_the_set_is_read_and_verified(mesh: Path, tmp_path: Path) -> None:
    blender = FakeBlender()
    manifest = make_set(mesh, tmp_path / "set", PLAN, lambda: blender)
    data = ObjectData(tmp_path / "set")
    assert (data.name, data.fps, data.train_frames) == ("box", 24, range(0, 4))
    assert (data.train_views, data.heldout_views) == (("cam_0", "cam_1"), ("cam_2",))
    assert [s.name for s in data.sequences] == ["seq_000", "seq_001", "seq_002"] and data.sequences[0].count == 4
    assert data.stills().images.shape == (23, 16, 16, 4)
    assert data.sequences[1].frames(range(4)).shape == (4, 3, 12, 20, 4)
    truth = data.ground_truth(data.sequences[2])
    assert truth is not None and truth.positions.shape == (4, 40, 3)
    assert (truth.positions[0] == truth.rest).all() and verify(tmp_path / "set") == []
    told, settings = manifest["results"], manifest["settings"]
    assert (settings["stills"], settings["stiffness"]) == (23, 0.7) and not {"pictures", "soft"} & set(settings)
    assert told["images"] == 23 + 3 * 4 * 3 and told["blender"]["bpy"] == "4.5"
    assert [s["kind"] for s in told["sequences"]] == ["poke", "drag", "double"]
    for entry in told["sequences"]:
        assert entry["amplitude_percent"] == pytest.approx(entry["amplitude_wanted_percent"], abs=2e-3)
        assert 8 <= entry["amplitude_percent"] <= 13
    assert [len(job["images"]) for job in blender.jobs] == [20, 3, 12, 12, 12]
    assert make_set(mesh, tmp_path / "set", PLAN, lambda: pytest.fail("asked for Blender"))["made"] is False


@pytest.mark.parametrize(("die_at", "version", "left"), [(30, "4.5", 29), (30, "4.5.16", 59)])
def test_what_the_same_blender_was_interrupted_at_goes_on_with_what_is_missing(mesh, tmp_path, die_at, version, left):
    make_set(mesh, tmp_path / "whole", PLAN, lambda: FakeBlender(version=version))
    with pytest.raises(BlenderError, match="gave up"):
        make_set(mesh, tmp_path / "set", PLAN, lambda: FakeBlender(die_at=die_at))
    assert not (tmp_path / "set").exists()
    second = FakeBlender(version=version)
    make_set(mesh, tmp_path / "set", PLAN, lambda: second)
    assert second.taken == left
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")


def test_several_workers_give_the_same_bytes_and_the_first_error_ends_all(mesh: Path, tmp_path: Path) -> None:
    for workers in (1, 3):
        make_set(mesh, tmp_path / str(workers), PLAN, FakeBlender, workers=workers)
    assert contents(tmp_path / "1") == contents(tmp_path / "3")
    with pytest.raises(BlenderError, match=r"0003\.png: Blender ended without writing it"):
        make_set(mesh, tmp_path / "set", PLAN, lambda: FakeBlender(skip="cam_1/0003.png"), workers=3)


def test_pushes_are_of_their_number_and_act_on_the_upper_part(surface: Surface) -> None:
    actions = [action(PLAN, surface, i) for i in range(10)]
    assert actions == [action(PLAN, surface, i) for i in range(10)]
    assert [a["kind"] for a in actions[:5]] == ["poke", "drag", "double", "poke", "drag"]
    assert [len(a["pushes"]) for a in actions[:5]] == [1, 1, 2, 1, 1]
    for push in (push for a in actions for push in a["pushes"]):
        assert np.linalg.norm(push["direction"]) == pytest.approx(1, abs=1e-3) and push["point"][2] > 0.3 * 2
    assert len({json.dumps(a["pushes"]) for a in actions}) == 10


def test_cameras_see_the_whole_object(surface: Surface) -> None:
    frames, folder = planning.frame_entries(PLAN, surface), Path("/set")
    stills = planning.still_job(PLAN, surface, folder, planning.still_entries(PLAN, surface))
    for job in (stills, planning.sequence_job(PLAN, surface, folder, 0, frames)):
        width, height = job["camera"]["size"]
        for image in job["images"]:
            view = np.linalg.inv(np.array(image["pose"])) * np.array([[1], [-1], [-1], [1]])
            seen = surface.vertices @ view[:3, :3].T + view[:3, 3]
            pixels = job["camera"]["focal"] * seen[:, :2] / seen[:, 2:] + (width / 2, height / 2)
            assert (seen[:, 2] > 0).all() and (pixels > 0).all() and (pixels < (width, height)).all()
    poses = [entry["transform_matrix"] for entry in frames[:3]]
    angles = [np.degrees(np.arctan2(pose[0][3], -pose[1][3])) % 360 for pose in poses]
    np.testing.assert_allclose(angles, [20, 200, 110])
    for size in ((540, 960), (960, 540)):
        assert camera(size)["focal"] == pytest.approx(270 / np.tan(np.radians(20)))


def program(path: Path, code: str) -> Path:
    """A stand-in for Blender's Python: runs this code, whatever script it is given."""
    path.write_text(f"#!{sys.executable} -S\nimport json, os, sys, time\n{code}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_a_process_gets_its_job_and_is_heard(tmp_path: Path) -> None:
    code = "job = json.load(sys.stdin)\nfor i in range(job['n']): print('image', flush=True)\n"
    code += "print(json.dumps(sys.argv[1:]))"
    heard: list[str] = []
    BlenderProcess(program(tmp_path / "python", code)).run({"n": 3}, heard.append, threading.Event())
    assert heard[:3] == ["image"] * 3
    flag, script, core = json.loads(heard[3])
    assert (flag, script) == ("-I", str(blender_env.SCRIPT)) and int(core) in os.sched_getaffinity(0)


def test_a_failed_process_says_why(tmp_path: Path) -> None:
    code = "sys.stderr.write('Fra:1 Mem:2\\nno push gives an amplitude\\n'); sys.exit(3)"
    blender = BlenderProcess(program(tmp_path / "python", code))
    with pytest.raises(BlenderError, match=r"exit code 3\):\nno push gives"):
        blender.run({"filler": "x" * (1 << 20)}, lambda _: None, threading.Event())
    with pytest.raises(BlenderError, match="expected a Python with bpy"):
        blender.versions()
    with pytest.raises(BlenderError, match="cannot be started"):
        BlenderProcess(tmp_path / "absent").run({}, lambda _: None, threading.Event())
    with pytest.raises(BlenderError, match="--blender-python"):
        find_blender(tmp_path / "absent")
    with pytest.raises(BlenderError, match="did not tell its versions"):
        BlenderProcess(program(tmp_path / "silent", "sys.stdin.read()")).versions()


def test_a_process_is_stopped_when_another_failed(tmp_path: Path) -> None:
    code = "sys.stdin.read()\nprint(os.getpid(), flush=True)\nwhile True: print('image', flush=True); time.sleep(0.01)"
    heard: list[str] = []
    stop = threading.Event()

    def told(step: str) -> None:
        heard.append(step)
        if len(heard) > 2:
            stop.set()

    with pytest.raises(BlenderError, match="another job failed"):
        BlenderProcess(program(tmp_path / "python", code)).run({}, told, stop)
    with pytest.raises(ProcessLookupError):
        os.kill(int(heard[0]), 0)
