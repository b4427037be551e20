"""The set made by Blender: its layout, resumption, environment and processes, with stand-ins for Blender and pip."""

import io
import json
import os
import stat
import struct
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
from data_prep.blender.meshes import Mesh, Surface, make_surface, read_mesh, refine
from data_prep.blender.plan import Pictures, Plan, action, camera
from data_prep.blender_bunny import make_set
from gausim.core import DataError
from gausim.data.objects import ObjectData
from gausim.data.verify import verify

PLAN = Plan(
    name="box", up="z", sequences=3, frames=4, views=3, heldout=1, points=40,
    pictures=Pictures(stills=23, resolution=(20, 12), still_resolution=(16, 16), samples=1),
)  # fmt: skip
CORNERS = [(x, y, z) for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    path = tmp_path / "box.obj"
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    lines += ["f " + " ".join(f"{i + 1}/1/{i + 1}" for i in quad) for quad in QUADS]
    path.write_text("# a box\nvt 0 0\n" + "\n".join(lines) + "\n")
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
    with pytest.raises(BlenderError, match="did not print its versions"):
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


TETRAHEDRON = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
POINTS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.2, 0.3, 1)], np.float64)


def ply(path: Path, encoding: str, faces: list[tuple[int, ...]]) -> Path:
    header = f"ply\nformat {encoding} 1.0\ncomment made here\nelement vertex {len(CORNERS)}\n"
    header += "property float x\nproperty float y\nproperty double z\nproperty uchar red\n"
    header += f"element face {len(faces)}\nproperty uchar quality\nproperty list uchar int vertex_indices\n"
    header += "end_header\n"
    if encoding == "ascii":
        lines = [f"{x} {y} {z} 255" for x, y, z in CORNERS]
        lines += [f"7 {len(face)} " + " ".join(map(str, face)) for face in faces]
        path.write_text(header + "\n".join(lines) + "\n")
        return path
    order = "<" if "little" in encoding else ">"
    body = b"".join(struct.pack(f"{order}ffdB", *corner, 255) for corner in CORNERS)
    body += b"".join(struct.pack(f"{order}BB{len(face)}i", 7, len(face), *face) for face in faces)
    path.write_bytes(header.encode() + body)
    return path


def volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = vertices[triangles.T]
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def test_obj_and_all_encodings_of_ply_give_the_same_box(mesh: Path, tmp_path: Path) -> None:
    expected = read_mesh(mesh)
    assert expected.vertices.tolist() == [list(c) for c in CORNERS] and expected.triangles.shape == (12, 3)
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        found = read_mesh(ply(tmp_path / f"{encoding}.ply", encoding, QUADS))
        np.testing.assert_array_equal(found.vertices, expected.vertices)
        np.testing.assert_array_equal(found.triangles, expected.triangles)


@pytest.mark.parametrize(
    "text", ["v 0 0\n", "v 0 0 x\n", "v 0 0 0\nf 1 a 1\n", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n",
             "v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "v 0 0 0\n", ""],
)  # fmt: skip
def test_damaged_obj(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.obj"
    path.write_text(text)
    with pytest.raises(DataError, match=r"bad\.obj: "):
        read_mesh(path)


def test_damaged_ply_and_useless_surfaces_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, encoding = tmp_path / "bad.ply", "binary_little_endian"
    with pytest.raises(DataError, match=r"bad\.ply: .*not there"):
        read_mesh(ply(path, encoding, [(0, 1, 8)]))
    whole = ply(path, encoding, QUADS).read_bytes()
    for length in range(0, len(whole) - 2, 37):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"bad\.ply: "):
            read_mesh(path)
    path = tmp_path / "m.obj"
    flat = Mesh(POINTS * (1, 1, 0), np.array(TETRAHEDRON))
    with pytest.raises(DataError, match="flat along its up axis 'z'"):
        make_surface(flat, path, up="z", points=4, seed=0)
    for vertices in (POINTS * 0, POINTS * (1, 0, 0)):
        with pytest.raises(DataError, match="no face has an area"):
            make_surface(Mesh(vertices, np.array(TETRAHEDRON)), path, up="z", points=4, seed=0)
    with pytest.raises(DataError, match="too large"):
        make_surface(Mesh((POINTS - 0.5) * 3e308, np.array(TETRAHEDRON)), path, up="z", points=4, seed=0)
    monkeypatch.setattr("data_prep.blender.meshes.MOST_TRIANGLES", 5000)
    with pytest.raises(DataError, match="Remesh"):
        refine(Mesh(POINTS, np.array(TETRAHEDRON)), 1e-4)


def test_surface_stands_upright_in_its_frame(mesh: Path) -> None:
    for up, extent in (("x", (4 / 3, 2, 2 / 3)), ("y", (2, 2 / 3, 4 / 3)), ("z", (2 / 3, 4 / 3, 2))):
        found = make_surface(read_mesh(mesh), mesh, up=up, points=50, seed=0)
        np.testing.assert_allclose(np.ptp(found.vertices, axis=0), extent, rtol=1e-6)
        np.testing.assert_allclose(found.vertices[:, :2].min(0), -found.vertices[:, :2].max(0), rtol=1e-6)
        assert found.vertices[:, 2].min() == 0 and len(found.gt_ids) == 50
        # Outward faces stay outward: the object is turned, not mirrored.
        original = read_mesh(mesh)
        turned = volume(found.vertices.astype(np.float64), found.faces)
        assert np.sign(turned) == np.sign(volume(original.vertices, original.triangles))


def test_refined_surface_is_closed_and_of_the_same_volume_and_area() -> None:
    mesh = Mesh(POINTS, np.array(TETRAHEDRON))
    fine = refine(mesh, 0.13)
    for found in (mesh, fine):
        np.testing.assert_allclose(volume(found.vertices, found.triangles), 1 / 6, rtol=1e-12)
        edges = np.concatenate([found.triangles[:, [i, (i + 1) % 3]] for i in range(3)])
        assert len(np.unique(edges, axis=0)) == len(edges)  # each directed edge once, so neighbours stay joined
        assert {tuple(e) for e in edges.tolist()} == {tuple(e[::-1]) for e in edges.tolist()}
    lengths = np.linalg.norm(np.diff(fine.vertices[edges], axis=1)[:, 0], axis=1)
    assert lengths.max() <= 0.13 and len(fine.triangles) > 100
