"""Public sets become ours: poses show the true points, the world is the right one, damaged files are refused."""

import json
import os
import pickle
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers import public_sets
from helpers.plain import Call
from helpers.public_sets import FRAMES, SEEN, Sample

from data_prep.public import import_public, main
from data_prep.public.phystwin import together
from data_prep.public.pickles import read_pickle
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


def test_pac_nerf_with_and_without_masks(sample_of: SampleOf, tmp_path: Path) -> None:
    sample = public_sets.write_pacnerf(tmp_path / "bird", rgba=True)
    data, _ = imported("pacnerf", sample.root, tmp_path / "out")
    assert data.fps == pytest.approx(24) and data.facts["floor"]["point"] == [0, 0, 0]
    check_views(data, sample, 1.0)
    manifest = import_public("pacnerf", sample_of("pacnerf").root, tmp_path / "bare")
    assert manifest["results"]["without_alpha"] == ["seq_000"]


def test_hands_of_phystwin(sample_of: SampleOf, tmp_path: Path) -> None:
    sample = sample_of("phystwin")
    data, results = imported("phystwin", sample.root, tmp_path / "out")
    assert results["notes"]["hands"] == "12 points, 6 + 6" and results["notes"]["tracks"].startswith("4 of 5 ")
    assert data.train_frames == range(SEEN) and data.fps == 30 and "free" not in data.facts
    assert data.facts["grip"] == 0.04 and data.facts["gravity"] == [0, 0, 9.8]
    check_views(data, sample, 40.0)
    with np.load(tmp_path / "out" / "sequences" / "seq_000" / "hands.npz") as hands:
        assert hands["hand"].tolist() == [0, 1] * 6
    truth = data.ground_truth(data.sequences[0])
    assert truth is not None
    np.testing.assert_allclose(truth.positions, sample.path[:, [0, 4, 6, 8]], atol=1e-6)
    assert (data.sequences[0].frames(range(FRAMES)).numpy()[:, :, :, :6, 3] == 0).all()  # the human's pixels
    with np.load(tmp_path / "out" / "points.npz") as cloud:
        np.testing.assert_allclose(cloud["points"], sample.path[0], atol=1e-6)


def test_pins_and_hands_are_read(tmp_path: Path) -> None:
    ways = np.stack((np.linspace(-1, 1, 9), np.linspace(1, -1, 9)))[[0, 1, 1, 0, 1]]
    noise = 0.02 * np.random.default_rng(1).standard_normal((5, 3))
    points = np.stack((ways, 0 * ways, 0 * ways), -1).transpose(1, 0, 2) + noise
    assert together(points[2:], 2).tolist() == [0, 1, 1, 0, 1] and together(points, 1).tolist() == [0] * 5
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
    ("pacnerf", "all_data.json", put(3, "file_path", to="../r_0_3.png"), "inside"),
    ("pacnerf", "all_data.json", put(3, "c2w", 0, 3, to=9.0), "stands still"),
    ("phystwin", "calibrate.pkl", lambda data: data[:2], "list of 3 poses"),
    ("phystwin", "calibrate.pkl", put(0, to=Call(os.mkdir, "canary")), "posix.mkdir"),
    ("phystwin", "final_data.pkl", put("controller_points", to=np.full((FRAMES, 12, 3), np.nan)), "controller_points"),
    ("phystwin", "split.json", put("test", to=[4, FRAMES]), "'train' [0, n]"),
    ("phystwin", "mask/mask_info_1.json", put("7", to="bear"), "expected one mask"),
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
        elif path.suffix == ".pkl":
            path.write_bytes(pickle.dumps(change(pickle.loads(good))))
        elif path.suffix == ".png":
            assert cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))
        else:
            path.write_bytes(change(good))
        with pytest.raises(GausSimError) as caught:
            imported(kind, root, tmp_path / "out", **options)
    finally:
        path.write_bytes(good)
    assert told in str(caught.value) and not (tmp_path / "out").exists() and not Path("canary").exists()


ARRAY = np.random.default_rng(0).standard_normal((4, 3, 2))
PLAIN = {"array": ARRAY, "turned": ARRAY.T, "order": ARRAY.astype(">f4"), "truth": ARRAY > 0, "none": np.zeros((0, 3)),
         "scalar": np.float64(2.5), "list": [1, -(2**70), "ä", b"\x00\xff", True, None, (2, ())]}  # fmt: skip


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_pickles_of_arrays_are_read(protocol: int, tmp_path: Path) -> None:
    path = tmp_path / "plain.pkl"
    data = pickle.dumps(PLAIN, protocol=protocol)
    for content in (data, data.replace(b"numpy._core", b"numpy.core")) if protocol < 4 else (data,):
        path.write_bytes(content)
        found = read_pickle(path)
        for key, value in PLAIN.items():
            np.testing.assert_equal(found[key], value)


HOSTILE: dict[str, Any] = {
    "posix.system": Call(os.system, "touch canary"), "builtins.eval": [Call(eval, "open('canary', 'w')")],
    "getattr": Call(getattr, Call(np.dtype, "f8"), "type"), "numpy.load": Call(np.load, "x", None, True),
    "elements of type 'O8'": np.array([{}], dtype=object), "elements of type 'V": np.zeros(1, "i4,f4"),
    "elements of type 'U": np.array(["text"]), "set": {1, 2}, "complex": 1j,
}  # fmt: skip


@pytest.mark.parametrize("protocol", [0, 2, 5])
@pytest.mark.parametrize("told", HOSTILE)
def test_nothing_else_in_a_pickle_is_read_or_executed(told, protocol, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "hostile.pkl"
    path.write_bytes(pickle.dumps(HOSTILE[told], protocol=protocol))
    with pytest.raises(DataError, match=r"hostile\.pkl: .*nothing in it is executed"):
        read_pickle(path)
    path.write_bytes(pickle.dumps(ARRAY)[:-40])
    with pytest.raises(DataError):
        read_pickle(path)
    assert not (tmp_path / "canary").exists()
