"""Masks of a scene from texts: every term, how they are joined, what is refused, and a picture that shows them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.plain import plain_scene

from data_prep.common.stage import read_manifest
from data_prep.ready.selections import parse_selection, read_points
from data_prep.select import main, select
from gausim.core import ConfigError, DataError, SceneError
from gausim.io.ply import load_scene, save_scene


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Two clumps of kernels: 40 in a unit cube around the origin, 20 around (5, 0, 0)."""
    rng = np.random.default_rng(1)
    means = rng.uniform(-0.5, 0.5, (60, 3))
    means[40:] = 0.4 * means[40:] + (5, 0, 0)
    save_scene(plain_scene(torch.from_numpy(means).float(), log_scale=-2.5, opacity=3.0), tmp_path / "scene.ply")
    (tmp_path / "scene.masks.npz").unlink()
    return tmp_path / "scene.ply"


def test_terms_are_joined_from_left_to_right(scene: Path, tmp_path: Path) -> None:
    found = load_scene(scene)
    x, y, z = found.means.numpy().T
    np.savetxt(tmp_path / "two points.txt", [[0.0, 0, 0], [5, 0, 0]])
    near = np.hypot(np.hypot(np.minimum(abs(x), abs(x - 5)), y), z) <= 0.3
    box = (abs(x) <= 1) & (abs(y) <= 0.2) & (abs(z) <= 1)
    cases = {
        "all": np.ones(60, bool), "not all or below z=0": z < 0,
        "below z=0.1 and above x=-0.2 or below y=-0.3": ((z < np.float32(0.1)) & (x > np.float32(-0.2))) | (y < -0.3),
        "below y=-0.3 or below z=0.1 and not box 1,-0.2,-1 -1,0.2,1": ((y < -0.3) | (z < np.float32(0.1))) & ~box,
        f"near '{tmp_path / 'two points.txt'}' 0.3": near, "component 1": np.arange(60) < 40,
        "component 1 4,0,0": np.arange(60) >= 40, "mask pinned or not not mask foreground": np.ones(60, bool),
    }  # fmt: skip
    for text, expected in cases.items():
        chosen, paths = parse_selection(text)
        assert chosen(found).tolist() == expected.tolist(), text
        assert len(paths) == text.count("near")


@pytest.mark.parametrize(
    "text",
    ["", "and all", "all and", "all all", "all not all", "not", "below w=1", "below z=inf", "box 1,2 3,4,5", "sphere 1",
     "box 0,0,nan 1,1,1", "component -1", "component nan", "component 1 2", "mask best", "near x.ply", "'all"],
)  # fmt: skip
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(SceneError):
        parse_selection(text)


def test_points_are_read_from_three_formats(scene: Path, tmp_path: Path) -> None:
    points = load_scene(scene).means.numpy()
    np.savez(tmp_path / "p.npz", points=points)
    np.savetxt(tmp_path / "p.txt", points, header="x y z")
    for path in (scene, tmp_path / "p.npz", tmp_path / "p.txt"):
        np.testing.assert_allclose(read_points(path), points, atol=1e-6)
    broken = {"a.txt": b"1 2\n3 4 5", "b.txt": b"1 2 nan", "c.txt": b"", "d.npz": b"PK", "f.txt": b"\xff"}
    for name, data in broken.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(DataError, match=name):
            read_points(tmp_path / name)
    with pytest.raises(DataError, match="no such file"):
        read_points(tmp_path / "missing.txt")


def test_the_stage_writes_masks_and_a_picture(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = [str(scene), "--simulated", "component 1", "--pinned", "below z=-0.2", "--size", "96"]
    assert main([*line, "--out", str(tmp_path / "out")]) == 0 and "40 of 60" in capsys.readouterr().out
    marked = load_scene(tmp_path / "out" / "scene.ply")
    z = marked.means[:, 2]
    assert marked.simulated.tolist() == [i < 40 for i in range(60)] and marked.foreground.all()
    assert torch.equal(marked.pinned, marked.simulated & (z < -0.2)) and marked.pinned.any()
    results = read_manifest(tmp_path / "out", "select")["results"]
    assert results["pinned"]["kernels"] == int(marked.pinned.sum()) and results["pinned"]["box"][1][2] < -0.2
    picture = cv2.imread(str(tmp_path / "out" / "masks.png")).astype(int)
    assert picture.shape == (3 * (96 + 24), 4 * 96, 3)
    rows = picture.reshape(3, 120, 4 * 96, 3)[:, 24:]
    greener, redder = rows[0][..., 1] - rows[0][..., 2] > 40, rows[1][..., 2] - rows[1][..., 1] > 40
    assert greener.sum() > redder.sum() > 0 and (abs(rows[1][..., 0] - rows[1][..., 1]) < 8).any()


def test_selections_that_hold_nothing_are_refused(scene, tmp_path, capsys) -> None:
    assert main([str(scene), "--pinned", "below z=-9", "--out", str(tmp_path / "out")]) == 2
    assert "mask 'pinned'" in capsys.readouterr().err and not (tmp_path / "out").exists()
    with pytest.raises(ConfigError, match="no mask"):
        select(scene, tmp_path / "out", {})
    with pytest.raises(SceneError, match="component radius"):
        parse_selection("component 1e9")[0](plain_scene(torch.zeros(6000, 3)))  # all pairs fill no memory
