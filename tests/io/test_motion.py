"""Motions as a page, as numbered PLY files and as a trajectory: what they hold, and what is refused."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.plain import FIELDS, random_scene, unit_motion, unit_scene

from gausim.core import DataError, DivergenceError, GaussianScene, Trajectory
from gausim.io.player import save_player
from gausim.io.ply import load_scene
from gausim.io.ply_sequence import save_ply_sequence
from gausim.io.trajectory import load_trajectory, save_trajectory
from gausim.ops.orbit import orbit_cameras


def positions_in(page: Path, scene: GaussianScene) -> torch.Tensor:
    """Positions of all kernels in all frames, as a page holds them; the rest scene is checked."""
    text = page.read_text()
    facts, content = (text.split(f'id="{name}">')[1].split("</script>")[0] for name in ("settings", "content"))
    facts, data = json.loads(facts), base64.b64decode(content)
    arrays = {
        name: torch.from_numpy(np.frombuffer(data, f"<{kind}", size, offset).astype("i8" if kind == "u4" else "f4"))
        for name, (kind, offset, size) in facts["arrays"].items()
    }
    frames, units = facts["frames"], facts["units"]
    assert torch.equal(arrays["rest"].reshape(-1, 3), scene.means)
    assert torch.allclose(arrays["scales"].reshape(-1, 3).log(), scene.log_scales, atol=1e-6)
    quats = torch.nn.functional.normalize(scene.quats, dim=-1)
    assert torch.allclose(arrays["quats"].reshape(-1, 4)[:, [3, 0, 1, 2]], quats, atol=1e-3)
    assert torch.allclose(arrays["opacities"], scene.opacity_logits.sigmoid(), atol=1e-3)
    high = arrays["sh"].reshape(scene.count, -1, 3) * torch.tensor(facts["sh_scales"])[:, None]
    assert torch.allclose(high, scene.sh[:, 1:], atol=float(scene.sh.abs().max()) / 253)  # half of 1 in 127 levels
    rest, unit = arrays["centres"].reshape(units, 3), arrays["unit_of_kernel"]
    moved = arrays["moved"].reshape(frames, units, 12)
    gradients = torch.eye(3) + moved[..., 3:].reshape(frames, units, 3, 3)
    offset = (scene.means - rest[unit])[..., None]
    shift = arrays["origins"].reshape(frames, 1, 3) + facts["diagonal"] * moved[..., :3]
    return rest[unit] + shift[:, unit] + (gradients[:, unit] @ offset)[..., 0]


def write(path: Path, scene: GaussianScene, made: Trajectory) -> Path:
    save_player(path, scene, made, orbit_cameras(scene.means, azimuths=[30.0]))
    return path


@pytest.mark.parametrize(("degree", "travel"), [(0, 0.0), (2, 0.0), (3, 40.0)])
def test_a_motion_comes_back(degree: int, travel: float, tmp_path: Path) -> None:
    scene = unit_scene(degree=degree)
    made = unit_motion(scene, travel=travel)
    page = write(tmp_path / "m.html", scene, made)
    error = (positions_in(page, scene) - made.positions).norm(dim=-1)
    assert float(error.max()) < 1e-3 * scene.diagonal
    longer = write(tmp_path / "long.html", scene, unit_motion(scene, frames=105, travel=travel))
    # Twelve half floats of every unit and an origin per frame, whatever the number of kernels, in base64.
    added = (longer.stat().st_size - page.stat().st_size) * 3 / 4
    assert abs(added - 100 * (6 * 24 + 12)) < 250


def test_still_kernels_do_not_move_and_strays_get_units_of_their_own(tmp_path: Path) -> None:
    scene = unit_scene()
    made = unit_motion(scene)
    made.positions[2:, 17] = made.positions[1, 17]  # held by hand
    page = write(tmp_path / "m.html", scene, made)
    found = positions_in(page, scene)
    assert torch.allclose(found[:, :5], scene.means[:5].expand(5, -1, -1), atol=1e-6)
    assert float((found - made.positions).norm(dim=-1).max()) < 1e-3 * scene.diagonal
    assert json.loads(page.read_text().split('id="settings">')[1].split("</script>")[0])["units"] > 6


def test_what_is_no_motion_of_the_scene_is_not_written(tmp_path: Path) -> None:
    scene, path = unit_scene(), tmp_path / "m.html"
    made = unit_motion(scene)
    with pytest.raises(DataError, match="has 60 kernels, the trajectory 50"):
        write(path, scene, unit_motion(unit_scene(count=50)))
    broken = replace(made, positions=made.positions.clone())
    broken.positions[3, 9] = torch.nan
    with pytest.raises(DivergenceError, match="frame 3 is not finite"):
        write(path, scene, broken)
    with pytest.raises(DataError, match="half floats"):
        write(path, scene, replace(made, deformation_gradients=1e5 * made.deformation_gradients))
    assert not path.exists()


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
