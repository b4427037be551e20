"""Motions as one compact file and as a page, and Gaussians as glTF: what they hold, and what is refused."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.glb_files import GlbFile
from helpers.unit_motions import unit_motion, unit_scene

from gausim.core import DataError, DivergenceError, GaussianScene
from gausim.io.gltf import save_gltf_frames
from gausim.io.motion import KEY, save_motion
from gausim.io.player import save_player
from gausim.ops.orbit import orbit_cameras


def positions_in(path: Path, scene: GaussianScene) -> torch.Tensor:
    """Positions of all kernels in all frames, as docs/reference/motion-file.md describes them; the rest is checked."""
    glb = GlbFile(path)
    facts = glb.document["extras"][KEY]
    glb.check_splats(scene, degree=0)
    frames, units, views = facts["frames"], facts["units"], facts["views"]
    masks = torch.from_numpy(glb.view(views["masks"], "u1").copy())
    for bit, name in enumerate(("simulated", "pinned", "foreground")):
        assert torch.equal((masks >> bit & 1).bool(), getattr(scene, name))
    levels = torch.from_numpy(glb.view(views["sh"], "i1").reshape(scene.count, -1, 3).astype("f4"))
    high = levels * torch.tensor(facts["sh_scales"])[:, None]
    assert torch.allclose(high, scene.sh[:, 1:], atol=float(scene.sh.abs().max()) / 253)  # half of 1 in 127 levels
    rest = torch.from_numpy(glb.view(views["rest_centres"], "<f4").reshape(units, 3).copy())
    origins = torch.from_numpy(glb.view(views["origins"], "<f4").reshape(frames, 1, 3).copy())
    moved = torch.from_numpy(glb.view(views["units"], "<f2").reshape(frames, units, 12).astype("f4"))
    unit = torch.from_numpy(glb.view(views["unit_of_kernel"], "<u2").astype("i8"))
    gradients = torch.eye(3) + moved[..., 3:].reshape(frames, units, 3, 3)
    offset = (scene.means - rest[unit])[..., None]
    shift = origins + facts["diagonal"] * moved[..., :3]
    return rest[unit] + shift[:, unit] + (gradients[:, unit] @ offset)[..., 0]


@pytest.mark.parametrize(("degree", "travel"), [(0, 0.0), (2, 0.0), (3, 40.0)])
def test_a_motion_comes_back(degree: int, travel: float, tmp_path: Path) -> None:
    scene = unit_scene(degree=degree)
    made = unit_motion(scene, travel=travel)
    save_motion(tmp_path / "m.motion.glb", scene, made)
    error = (positions_in(tmp_path / "m.motion.glb", scene) - made.positions).norm(dim=-1)
    assert float(error.max()) < 1e-3 * scene.diagonal
    facts = GlbFile(tmp_path / "m.motion.glb").document["extras"][KEY]
    assert facts["fps"] == made.fps and facts["volume_scale"] == scene.volume_scale
    size = (tmp_path / "m.motion.glb").stat().st_size
    longer = unit_motion(scene, frames=105, travel=travel)
    save_motion(tmp_path / "long.motion.glb", scene, longer)
    # Twelve half floats of every unit and an origin per frame, whatever the number of kernels.
    added = (tmp_path / "long.motion.glb").stat().st_size - size
    assert abs(added - 100 * (6 * 24 + 12)) < 200


def test_still_kernels_do_not_move_and_strays_get_units_of_their_own(tmp_path: Path) -> None:
    scene = unit_scene()
    made = unit_motion(scene)
    made.positions[2:, 17] = made.positions[1, 17]  # held by hand
    save_motion(tmp_path / "m.motion.glb", scene, made)
    found = positions_in(tmp_path / "m.motion.glb", scene)
    assert torch.allclose(found[:, :5], scene.means[:5].expand(5, -1, -1), atol=1e-6)
    assert float((found - made.positions).norm(dim=-1).max()) < 1e-3 * scene.diagonal
    assert GlbFile(tmp_path / "m.motion.glb").document["extras"][KEY]["units"] > 6


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


def test_frames_as_gltf_come_back_and_a_reader_that_is_not_ours_opens_them(tmp_path: Path) -> None:
    scenes = [unit_scene(), unit_scene(count=40, degree=3)]
    assert save_gltf_frames(tmp_path, "toy", scenes) == 2
    for number, scene in enumerate(scenes, start=1):
        glb = GlbFile(tmp_path / f"toy_000{number}.glb")
        glb.check_splats(scene)
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
