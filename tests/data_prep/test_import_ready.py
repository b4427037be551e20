"""READY's own layout becomes ours: which sequences count, whose cameras they have, masks by points and by lists."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import colmap_files
from helpers.plain import Call
from helpers.public_sets import write_cloud
from helpers.toy_object import toy_scene

from data_prep.import_ready import ReadyOptions, import_ready, main
from data_prep.ready.authors import read_pins
from gausim.core import ConfigError, DataError
from gausim.data.objects import ObjectData
from gausim.data.records import read_stills
from gausim.io.ply import load_scene, save_scene
from gausim.io.transforms import read_transforms

SIZE = 32, 24
FRAMES = 3
OPTIONS = ReadyOptions(train_frames=2)
# Sequence 2 has no cameras of its own in the model, it shares those of its twin 1; 3 has one camera more; 4 is invalid.
VIDEOS = {"seq_00001": (0, 1), "seq_00002": (0, 1), "seq_00003": (0, 1, 2), "seq_00004": (0, 1)}


def image(path: Path, value: int, channels: int = 3) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.full((SIZE[1], SIZE[0], channels), value, np.uint8)
    if channels == 1:
        pixels[:, : SIZE[0] // 2] = 0
    cv2.imwrite(str(path), pixels)


@pytest.fixture
def ready(tmp_path: Path) -> Path:
    root = tmp_path / "duck"
    cameras = {1: ("PINHOLE", 2 * SIZE[0], 2 * SIZE[1], [60.0, 60.0, 32.0, 24.0])}
    names = ["still_a.png", "still_b.png"]
    names += [f"{s}_cam_{c:05d}.png" for s, views in VIDEOS.items() if s != "seq_00002" for c in views]
    images = {i: (name, 1, *colmap_files.turntable(0.5 * i), []) for i, name in enumerate(names)}
    colmap_files.write_binary(root / "sparse" / "0", cameras, images, colmap_files.small_model()[2])
    for name in names:
        image(root / "images" / name, 120)
    for name in names[:2]:
        image(root / "masks" / name, 255, channels=1)
    for sequence, views in VIDEOS.items():
        for view in views:
            for frame in range(FRAMES):
                place = f"{sequence}_cam_{view:05d}/{frame}.png"
                image(root / "video_images" / place, 50 * frame)
                image(root / "video_masks" / place, 255, channels=1)
    meta = {"train": [1, "seq_00002"], "test": ["00003"], "invalid": [], "force_invalid": [4], "twins": [[1, 2]]}
    (root / "meta.json").write_text(json.dumps(meta))
    scene = toy_scene()
    save_scene(scene, root / "point_cloud.ply")
    (root / "point_cloud.masks.npz").unlink()
    means = scene.means.numpy()
    for name, chosen in (("moving_part_points", means[:, 2] > 0.3), ("clean_object_points", means[:, 0] > -0.1)):
        write_cloud(root / f"{name}.ply", means[chosen] + 0.004)
    (root / "pin_mask.json").write_text(json.dumps({"indices": np.flatnonzero(means[:, 2] < 0.4).tolist()}))
    (root / "sim_mask.pkl").write_bytes(pickle.dumps(Call(os.mkdir, str(tmp_path / "canary"))))
    return root


def test_the_layout_becomes_ours(ready: Path, tmp_path: Path) -> None:
    results = import_ready(ready, tmp_path / "out", OPTIONS)["results"]
    assert results["stills"] == 2 and results["without_alpha"] == []
    assert results["left_out"] == {"seq_00004": "meta.json calls it invalid"}
    assert results["sequences"]["seq_00003"] == {"frames": FRAMES, "cameras_left_out": ["cam_00002"]}
    data = ObjectData(tmp_path / "out")
    assert (data.name, data.fps, data.views) == ("duck", 50.0, ("cam_00000", "cam_00001"))
    assert data.facts["train_sequences"] == ["seq_00001", "seq_00002"] and data.facts["test_sequences"] == ["seq_00003"]
    assert [record.name for record in data.sequences] == ["seq_00001", "seq_00002", "seq_00003"]
    first, twin, third = data.sequences
    np.testing.assert_array_equal(first.cameras.viewmats, twin.cameras.viewmats)
    assert not np.allclose(first.cameras.viewmats, third.cameras.viewmats)
    # The model is for twice the size of the images.
    np.testing.assert_allclose(first.cameras.Ks[0], [[30, 0, 16], [0, 30, 12], [0, 0, 1]])
    pixels = twin.frames(range(FRAMES)).numpy()
    assert (pixels[2, 1, :, SIZE[0] // 2 :] == [100, 100, 100, 255]).all()
    assert (pixels[..., : SIZE[0] // 2, 3] == 0).all()
    stills = read_stills(tmp_path / "out" / "static" / "transforms.json")
    assert stills.images.shape == (2, SIZE[1], SIZE[0], 4)
    assert [f.path.name for f in read_transforms(tmp_path / "out/static/transforms.json").frames][1] == "still_b.png"


def test_masks_follow_the_point_clouds(ready: Path, tmp_path: Path) -> None:
    import_ready(ready, tmp_path / "out", OPTIONS)
    scene = load_scene(tmp_path / "out" / "scene.ply")
    x, _, z = scene.means.numpy().T
    assert scene.simulated.tolist() == (z > 0.3).tolist() and scene.foreground.tolist() == (x > -0.1).tolist()
    assert scene.pinned.tolist() == ((z > 0.3) & (z < 0.4)).tolist() and scene.pinned.any()
    assert not (tmp_path / "canary").exists()


def test_without_masks_it_says_what_is_to_be_segmented(ready: Path, tmp_path: Path) -> None:
    (ready / "video_masks").rename(ready / "elsewhere")
    results = import_ready(ready, tmp_path / "out", OPTIONS)["results"]
    assert results["without_alpha"] == ["seq_00001", "seq_00002", "seq_00003"]
    results = import_ready(ready, tmp_path / "two", OPTIONS, video_masks=ready / "elsewhere")["results"]
    assert results["without_alpha"] == []


def test_faults_are_named(ready: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    line = [str(ready), "--out", str(out), "--train-frames", "2"]
    with pytest.raises(ConfigError, match="--heldout"):
        import_ready(ready, out, ReadyOptions(train_frames=2, heldout=("cam_7",)))
    with pytest.raises(DataError, match="fewer than --train-frames"):
        import_ready(ready, out, ReadyOptions(train_frames=9))
    (ready / "video_masks" / "seq_00001_cam_00001" / "1.png").unlink()
    assert main(line) == 2 and "no mask of" in capsys.readouterr().err
    (ready / "images" / "still_a.png").unlink()
    assert main(line) == 2 and "still_a.png" in capsys.readouterr().err
    for text in ("[]", "{", '{"train": [{}]}', '{"train": 3}', '{"twins": [[1, 2, 3]]}', '{"train": [1], "test": [1]}'):
        (ready / "meta.json").write_text(text)
        assert main(line) == 2 and "meta.json" in capsys.readouterr().err
    assert not out.exists()


def test_pins_are_numbers_or_truth_values_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "pin_mask.json"
    for text in ("[0, 3]", '{"pins": [3, 0], "name": "x"}', "[true, false, false, true]"):
        path.write_text(text)
        assert read_pins(path, 4).tolist() == [True, False, False, True]
    for text in ("{}", "[1.5]", "[-1]", "[4]", "[true]", '["1"]', "nonsense"):
        path.write_text(text)
        with pytest.raises(DataError, match=r"pin_mask\.json"):
            read_pins(path, 4)
