"""Motions as one compact file and as a page, and Gaussians as glTF: what comes back, and what is refused."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.unit_motions import unit_motion, unit_scene

from gausim.core import DataError, DivergenceError, GaussianScene, Trajectory
from gausim.io.gltf import EXTENSION, read_glb, save_gltf_frames, splat_scene
from gausim.io.motion import KEY, load_motion, save_motion
from gausim.io.player import save_player
from gausim.ops.covariance import covariance_from_scales, transport_covariance
from gausim.ops.orbit import orbit_cameras


def deformed_covariances(scene: GaussianScene, motion: Trajectory) -> torch.Tensor:
    rest = covariance_from_scales(scene.log_scales, scene.quats)
    return transport_covariance(rest, motion.deformation_gradients[:, motion.unit_of_kernel])


def check_back(scene: GaussianScene, made: Trajectory, path: Path) -> None:
    again, back = load_motion(path)
    assert back.fps == made.fps and back.frames == made.frames
    assert float((back.positions - made.positions).norm(dim=-1).max()) < 1e-3 * scene.diagonal
    for name in ("simulated", "pinned", "foreground"):
        assert torch.equal(getattr(again, name), getattr(scene, name))
    assert again.volume_scale == scene.volume_scale and again.sh_degree == scene.sh_degree
    assert torch.equal(again.means, scene.means) and torch.equal(again.sh[:, 0], scene.sh[:, 0])
    assert torch.allclose(again.log_scales, scene.log_scales, atol=1e-6)
    assert float((again.sh - scene.sh).abs().max()) <= float(scene.sh.abs().max()) / 253  # half of 1 in 127 levels
    ours, theirs = deformed_covariances(scene, made), deformed_covariances(again, back)
    assert float(((ours - theirs).norm(dim=(-1, -2)) / ours.norm(dim=(-1, -2))).max()) < 3e-3
    turned = made.rotations[:, made.unit_of_kernel] - back.rotations[:, back.unit_of_kernel]
    assert float(turned.abs().max()) < 2e-3


@pytest.mark.parametrize(("degree", "travel"), [(0, 0.0), (2, 0.0), (3, 40.0)])
def test_a_motion_comes_back(degree: int, travel: float, tmp_path: Path) -> None:
    scene = unit_scene(degree=degree)
    made = unit_motion(scene, travel=travel)
    save_motion(tmp_path / "m.motion.glb", scene, made)
    check_back(scene, made, tmp_path / "m.motion.glb")
    size = (tmp_path / "m.motion.glb").stat().st_size
    longer = unit_motion(scene, frames=105, travel=travel)
    save_motion(tmp_path / "long.motion.glb", scene, longer)
    # Twelve half floats of every unit and an origin per frame, whatever the number of kernels.
    added = (tmp_path / "long.motion.glb").stat().st_size - size
    assert abs(added - 100 * (6 * 24 + 12)) < 200


def test_still_kernels_do_not_move_at_all_and_strays_get_units_of_their_own(tmp_path: Path) -> None:
    scene = unit_scene()
    made = unit_motion(scene)
    made.positions[2:, 17] = made.positions[1, 17]  # held by hand
    save_motion(tmp_path / "m.motion.glb", scene, made)
    _, back = load_motion(tmp_path / "m.motion.glb")
    assert torch.equal(back.positions[:, :5], scene.means[:5].expand(5, -1, -1))
    assert float((back.positions - made.positions).norm(dim=-1).max()) < 1e-3 * scene.diagonal
    assert back.deformation_gradients.shape[1] > made.deformation_gradients.shape[1]


def test_what_is_no_motion_of_the_scene_is_not_written(tmp_path: Path) -> None:
    scene, path = unit_scene(), tmp_path / "m.motion.glb"
    made = unit_motion(scene)
    with pytest.raises(DataError, match="has 60 kernels, the trajectory 50"):
        save_motion(path, scene, unit_motion(unit_scene(count=50)))
    broken = replace(made, positions=made.positions.clone())
    broken.positions[3, 9] = torch.nan
    with pytest.raises(DivergenceError, match="frame 3 is not finite"):
        save_motion(path, scene, broken)
    with pytest.raises(DataError, match="half floats"):
        save_motion(path, scene, replace(made, deformation_gradients=1e5 * made.deformation_gradients))
    assert not path.exists()


def rewritten(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """The file with another JSON part."""
    glb = read_glb(path)
    change(glb.document)
    path.write_bytes(replace(glb, binary=bytes(glb.binary)).to_bytes())
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("extras"), "no 'extras.gausim_motion'"),
        (lambda d: d["extras"][KEY].update(version=2), "field 'version': expected 1, got 2"),
        (lambda d: d["extras"][KEY].update(frames=4), "field 'origins': expected 48 bytes"),
        (lambda d: d["extras"][KEY].update(frames=0), "field 'frames"),
        (lambda d: d["extras"][KEY].update(units=7), "field 'rest_centres': expected 84 bytes"),
        (lambda d: d["extras"][KEY].update(diagonal="x"), "field 'diagonal"),
        (lambda d: d["extras"][KEY].update(fps=-1), "field 'fps"),
        (lambda d: d["extras"][KEY].update(sh_scales=[0.1]), "field 'sh_scales': expected 0, 3, 8 or 15"),
        (lambda d: d["extras"][KEY]["views"].update(units=99), "field 'units': expected an index of"),
        (lambda d: d["extras"][KEY]["views"].pop("masks"), "masks"),
        (lambda d: d["bufferViews"][0].update(byteOffset=-4), "bufferViews.0. of 'POSITION'"),
        (lambda d: d["bufferViews"][0].update(byteLength=1 << 40), "bufferViews.0. of 'POSITION'"),
        (lambda d: d["accessors"][0].update(componentType=5123), "attribute 'POSITION': expected 60 rows of 3 float32"),
        (lambda d: d["meshes"].clear(), "field 'meshes': expected one primitive"),
        (
            lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(f"{EXTENSION}:SCALE"),
            "SCALE': expected an index",
        ),
    ],
)
def test_damaged_motions_are_refused_by_field(change: Callable, message: str, tmp_path: Path) -> None:
    path, scene = tmp_path / "m.motion.glb", unit_scene()
    save_motion(path, scene, unit_motion(scene))
    with pytest.raises(DataError, match=message) as told:
        load_motion(rewritten(path, change))
    assert str(path) in str(told.value)


def test_damaged_numbers_are_refused_by_field(tmp_path: Path) -> None:
    path, scene = tmp_path / "m.motion.glb", unit_scene()
    save_motion(path, scene, unit_motion(scene))
    good = read_glb(path)
    views = good.document["extras"][KEY]["views"]
    for name, bad, message in (
        ("units", np.full(2, np.nan, "<f2"), "field 'units' is NaN"),
        ("origins", np.full(1, np.inf, "<f4"), "field 'origins' is NaN or infinite"),
        ("unit_of_kernel", np.full(1, 6, "<u2"), "field 'unit_of_kernel': expected indices of 6 units"),
        ("masks", np.full(1, 2, "u1"), "'pinned' marks kernels that mask 'simulated' leaves out"),
    ):
        binary = bytearray(good.binary)
        start = good.document["bufferViews"][views[name]]["byteOffset"]
        binary[start : start + bad.nbytes] = bad.tobytes()
        path.write_bytes(replace(good, binary=binary).to_bytes())
        with pytest.raises(DataError, match=message):
            load_motion(path)


def test_what_is_no_glb_is_refused(tmp_path: Path) -> None:
    path, scene = tmp_path / "m.motion.glb", unit_scene()
    with pytest.raises(DataError, match=r"m.motion.glb: cannot be read \(No such file"):
        load_motion(path)
    save_motion(path, scene, unit_motion(scene))
    data = path.read_bytes()
    for bad, message in (
        (b"ply\n" + data[4:], "expected a binary glTF 2.0 file, got b'ply"),
        (data[:4] + struct.pack("<I", 1) + data[8:], "expected a binary glTF 2.0 file"),
        (data[:-100], "a JSON and a binary part"),
        (data[:12] + struct.pack("<I", 1 << 31) + data[16:], "a JSON and a binary part"),
        (data[:20] + b"[" + data[21:], "the JSON part cannot be read"),
    ):
        path.write_bytes(bad)
        with pytest.raises(DataError, match=message):
            load_motion(path)


def test_frames_as_gltf_come_back_and_a_reader_that_is_not_ours_opens_them(tmp_path: Path) -> None:
    scenes = [unit_scene(), unit_scene(count=40, degree=3)]
    assert save_gltf_frames(tmp_path, "toy", scenes) == 2
    for number, scene in enumerate(scenes, start=1):
        glb = read_glb(tmp_path / f"toy_000{number}.glb")
        again = splat_scene(glb, "toy")
        assert torch.equal(again.means, scene.means) and torch.equal(again.sh, scene.sh)
        assert torch.allclose(again.opacity_logits.sigmoid(), scene.opacity_logits.sigmoid(), atol=1e-7)
        assert torch.allclose(again.log_scales, scene.log_scales, atol=1e-6)
        quats = scene.quats / scene.quats.norm(dim=-1, keepdim=True)
        assert torch.allclose(again.quats, quats, atol=1e-7)
        assert glb.document["nodes"][0]["rotation"][0] < 0  # z up is turned to y up
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh (extra view)")
    cloud = next(iter(trimesh.load(tmp_path / "toy_0001.glb").geometry.values()))
    assert np.array_equal(cloud.vertices.astype(np.float32), scenes[0].means.numpy())
    assert np.abs(cloud.colors[:, 3] - 255 * torch.sigmoid(scenes[0].opacity_logits).numpy()).max() <= 0.51


def test_a_page_holds_the_motion_and_refuses_the_network(tmp_path: Path) -> None:
    scene = replace(unit_scene(), name="<b>evil & co</b> {{ settings }}")
    made, path = unit_motion(scene), tmp_path / "m.html"
    save_player(path, scene, made, orbit_cameras(scene.means, azimuths=[30.0]), background=torch.ones(3))
    text = path.read_text()
    assert "<title>&lt;b&gt;evil &amp; co&lt;/b&gt; {{ settings }} - gausim</title>" in text
    assert text.index("default-src 'none'") < text.index("<script")
    assert not re.search(r"https?:|//[\w-]+\.\w|\bimport\b|\bfetch\(|src=|href=|url\(", text.split('id="motion"')[0])
    script = text.rsplit("<script>", 1)[1]
    assert not re.search(r"https?:|\bimport\b|\bfetch\(|XMLHttpRequest|WebSocket", script)
    settings = json.loads(re.search(r'id="settings">(.*?)</script>', text).group(1))  # type: ignore[union-attr]
    assert settings["background"] == [1.0, 1.0, 1.0] and settings["camera"]["up"] == [0.0, 0.0, 1.0]
    assert settings["camera"]["fov"] == pytest.approx(np.radians(40), abs=1e-6)
