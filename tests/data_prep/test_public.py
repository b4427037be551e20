"""Public sets become ours: poses show the true points, the world is the right one, damaged files are refused."""

import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.public_sets import FRAMES, Sample

from data_prep.public import import_public, main
from data_prep.ready.marks import read_pins
from gausim.core import ConfigError, DataError, GausSimError
from gausim.data.objects import ObjectData
from gausim.data.verify import verify
from gausim.io.ply import load_scene
from gausim.ops.visual_hull import project

SampleOf = Callable[[str], Any]


def imported(kind: str, root: Path, out: Path, **options: Any) -> tuple[ObjectData, dict[str, Any]]:
    chosen = import_module(f"data_prep.public.{kind}").Options(**options)
    manifest = import_public(kind, root, out, chosen)
    return ObjectData(out), manifest["results"]


def check_views(data: ObjectData, sample: Sample, tolerance: float) -> None:
    """Every ball is seen at its true place in every view of the first, a middle and the last frame."""
    record = data.sequences[-1]
    pixels = record.frames(range(record.count)).numpy()
    assert record.count == FRAMES and pixels.shape[1] == 3
    for frame in (0, 4, FRAMES - 1):
        points = torch.from_numpy(sample.path[frame]).float()
        places, _ = project(points, record.cameras.viewmats, record.cameras.Ks)
        for view in range(3):
            x, y = places[view].numpy().astype(int).T
            inside = (x >= 0) & (x < record.cameras.width) & (y >= 0) & (y < record.cameras.height)
            assert inside.mean() > 0.9 and (pixels[frame, view, y[inside], x[inside], 3] > 127).mean() > 0.9
            truth = sample.image(frame, view)
            both = (truth[..., 3] > 250) & (pixels[frame, view, ..., 3] > 127)
            assert both.sum() > 0.7 * (truth[..., 3] > 250).sum()
            assert np.abs(pixels[frame, view][both].astype(float) - truth[both]).mean() < tolerance


def test_a_fall_keeps_its_world(sample_of: SampleOf, tmp_path: Path) -> None:
    sample = sample_of("springgaus")
    data, results = imported("springgaus", sample.root, tmp_path / "out")
    assert verify(tmp_path / "out") == [] and results["without_alpha"] == [] and data.name == sample.root.name
    assert data.fps == pytest.approx(1 / 0.03) and data.train_frames == range(FRAMES) and data.heldout_views == ()
    assert data.facts["gravity"] == [0, -9.8, 0] and data.facts["free"] is True
    assert (data.facts["floor"]["point"], data.facts["floor"]["normal"]) == ([0, 0.3, 0], [0, 1, 0])
    check_views(data, sample, 1.0)
    np.testing.assert_array_equal(data.stills().images[1], data.sequences[0].frames(range(1))[0, 1])


def test_smaller_pictures_and_views_held_out(sample_of: SampleOf, tmp_path: Path) -> None:
    root = sample_of("springgaus").root
    options = {"longest": 24, "heldout": ("camera_1",), "train_frames": 6, "name": "ring", "fps": 30.0}
    data, _ = imported("springgaus", root, tmp_path / "out", **options)
    assert (data.name, data.fps, data.train_frames, data.heldout_views) == ("ring", 30, range(6), ("camera_1",))
    assert len(data.stills().images) == 2 and data.sequences[0].cameras.width == 24
    with pytest.raises(ConfigError, match="--heldout camera_7"):
        imported("springgaus", root, tmp_path / "no", heldout=("camera_7",))


def test_pins_are_read(tmp_path: Path) -> None:
    path = tmp_path / "pin_mask.json"
    for text in ("[0, 3]", '{"pins": [3, 0], "name": "x"}', "[true, false, false, true]"):
        path.write_text(text)
        assert read_pins(path, 4).tolist() == [True, False, False, True]
    for text in ("{}", "[1.5]", "[-1]", "[4]", "[true]", '["1"]', "nonsense"):
        path.write_text(text)
        with pytest.raises(DataError, match=r"pin_mask\.json"):
            read_pins(path, 4)


def test_stills_and_a_film_of_physdreamer(sample_of: SampleOf, tmp_path: Path) -> None:
    root = sample_of("physdreamer").root
    masks = root.parent / "video_masks"
    data, results = imported("physdreamer", root, tmp_path / "out", anchor=0.4, video_masks=masks)
    assert results["without_alpha"] == [] and (results["stills"], results["sequences"]) == (3, {"seq_000": FRAMES})
    assert (data.fps, data.views, data.train_frames) == (30, ("frame_00002",), range(FRAMES))
    stills = data.stills()
    np.testing.assert_allclose(data.sequences[0].cameras.viewmats[0], stills.cameras.viewmats[1], atol=1e-5)
    film, still = data.sequences[0].frames(range(1)).numpy()[0, 0], stills.images[1].numpy()
    np.testing.assert_array_equal(film[..., 3], still[..., 3])
    assert np.abs(film[still[..., 3] > 127].astype(float) - still[still[..., 3] > 127]).mean() < 12  # coded colours
    scene = load_scene(tmp_path / "out" / "scene.ply")
    z = scene.means[:, 2].numpy()
    # Moving: above 0.5; pinned: the layer below, 0.35 away.
    assert scene.simulated.tolist() == (z > 0.2).tolist() and scene.pinned.tolist() == ((z > 0.2) & (z < 0.5)).tolist()
    assert main(["physdreamer", str(root), "--out", str(tmp_path / "bare"), "--anchor", "0.4"]) == 0
    assert json.loads((tmp_path / "bare" / "stage.json").read_text())["results"]["without_alpha"] == ["seq_000"]


def test_readys_layout(sample_of: SampleOf, tmp_path: Path) -> None:
    toy = sample_of("ready")
    data, results = imported("ready", toy.root, tmp_path / "out", train_frames=2)
    assert results["stills"] == 2 and results["without_alpha"] == []
    assert results["notes"] == {"seq_00004 left out": "meta.json calls it invalid", "seq_00003 without": "cam_00002"}
    assert (data.name, data.fps, data.views) == ("duck", 50.0, ("cam_00000", "cam_00001"))
    assert data.facts["train_sequences"] == ["seq_00001", "seq_00002"] and data.facts["test_sequences"] == ["seq_00003"]
    first, twin, third = data.sequences
    np.testing.assert_array_equal(first.cameras.viewmats, twin.cameras.viewmats)
    np.testing.assert_allclose(third.cameras.Ks[0], toy.views.Ks[0])  # the model is for twice the size of the images
    frames = toy.images("seq_000").numpy()[:3, :2]
    np.testing.assert_array_equal(third.frames(range(3)).numpy()[..., 3], frames[..., 3])
    scene = load_scene(tmp_path / "out" / "scene.ply")
    z = scene.means[:, 2].numpy()
    assert scene.simulated.tolist() == (z > 0.5).tolist() and scene.pinned.tolist() == ((z > 0.5) & (z < 0.8)).tolist()
    (toy.root / "video_masks").rename(toy.root / "elsewhere")
    try:
        _, results = imported("ready", toy.root, tmp_path / "bare", train_frames=2)
        assert results["without_alpha"] == ["seq_00001", "seq_00002", "seq_00003"]
    finally:
        (toy.root / "elsewhere").rename(toy.root / "video_masks")


def put(*place: Any, to: Any) -> Callable[[Any], Any]:
    """Replaces what is at a place of plain data."""

    def change(data: Any) -> Any:
        inner = data
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = to
        return data

    return change


def narrow(pixels: np.ndarray) -> np.ndarray:
    return pixels[:, :-8]


# Kind, file, what happens to it (None: it is gone), what the error says besides the file.
DAMAGE: list[tuple[str, str, Callable[[Any], Any] | None, str]] = [
    ("springgaus", "camera.json", put(1, "c2w", 0, 0, to=5.0), "rotation"),
    ("springgaus", "camera.json", put(1, "K", 1, 1, to=0.0), "fx"),
    ("springgaus", "frame.json", put(3, to={"t": 0.5}), "equal steps"),
    ("springgaus", "camera_1/003.png", None, "frame 3 is missing"),
    ("springgaus", "camera_1/003.png", narrow, "is for 48x48"),
    ("physdreamer", "sparse/0/images.bin", lambda data: data[:-9], "truncated"),
    ("physdreamer", "images/frame_00003.png", narrow, "another shape"),
    ("physdreamer", "videos/frame_00002_poke.mp4", lambda data: data[:300], ""),
    ("ready", "meta.json", put("train", to=["00003"]), "share"),
    ("ready", "video_masks/seq_00001_cam_00001/1.png", None, "no mask of"),
]


@pytest.mark.parametrize(("kind", "file", "change", "told"), DAMAGE, ids=lambda v: v if isinstance(v, str) else "")
def test_damaged_files_are_refused(kind, file, change, told, sample_of, tmp_path) -> None:
    root = sample_of(kind).root
    path, options = root / file, {"anchor": 0.4} if kind == "physdreamer" else {}
    good = path.read_bytes()
    try:
        if change is None:
            path.unlink()
        elif path.suffix == ".json":
            path.write_text(json.dumps(change(json.loads(good))))
        elif path.suffix == ".png":
            assert cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
        else:
            path.write_bytes(change(good))
        with pytest.raises(GausSimError) as caught:
            imported(kind, root, tmp_path / "out", **options)
    finally:
        path.write_bytes(good)
    assert told in str(caught.value) and not (tmp_path / "out").exists()
