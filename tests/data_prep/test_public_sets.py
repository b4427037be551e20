"""Public sets become ours: the poses show the true points, the world is the right one, damaged files are refused."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from helpers import public_sets
from helpers.public_sets import FRAMES, SEEN, Sample

from data_prep import import_3dgsim, import_pacnerf, import_physdreamer, import_phystwin, import_springgaus
from data_prep.import_3dgsim import GenesisOptions
from data_prep.import_pacnerf import PacNerfOptions
from data_prep.import_physdreamer import PhysDreamerOptions
from data_prep.import_phystwin import PhysTwinOptions, together
from data_prep.import_springgaus import SpringGausOptions
from data_prep.public import registration
from data_prep.public.importing import CURRICULUM, train_command
from data_prep.public.pictures import before_white
from gausim.core import ConfigError, GausSimError
from gausim.data.objects import ObjectData
from gausim.data.records import read_stills
from gausim.data.verify import verify
from gausim.io.ply import load_scene
from gausim.ops.visual_hull import project

REAL = SpringGausOptions(object="bun", no_stills=True)
SMALL = {"REFINED": 4, "VOXELS": 40, "REFINEMENT_STEPS": 150}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("public")


@pytest.fixture(scope="module")
def springgaus(folder: Path) -> Sample:
    return public_sets.write_springgaus(folder / "render" / "torus")


@pytest.fixture(scope="module")
def real(folder: Path) -> Sample:
    return public_sets.write_springgaus_real(folder / "real_capture")


@pytest.fixture(scope="module")
def pacnerf(folder: Path) -> Sample:
    return public_sets.write_pacnerf(folder / "data" / "bird")


@pytest.fixture(scope="module")
def phystwin(folder: Path) -> Sample:
    return public_sets.write_phystwin(folder / "different_types" / "double_stretch_sloth")


@pytest.fixture(scope="module")
def genesis(folder: Path) -> Sample:
    return public_sets.write_3dgsim(folder / "genesis" / "dog")


@pytest.fixture(scope="module")
def physdreamer(folder: Path) -> Path:
    return public_sets.write_physdreamer(folder / "physics_dreamer" / "hat").root


def check_views(data: ObjectData, sample: Sample, *, tolerance: float = 40.0, solid: int = 250) -> None:
    """Every ball is seen at its true place in every view of the first, a middle and the last frame."""
    record = data.sequences[-1]
    pixels = record.frames(range(record.count)).numpy()
    assert record.count == FRAMES and pixels.shape[1] == 3
    for frame in (0, 9, FRAMES - 1):
        points = np.concatenate((sample.path[frame], sample.path[frame] + 0.3 * sample.body.radii[:, None]))
        places, _ = project(torch_of(points), record.cameras.viewmats, record.cameras.Ks)
        for view in range(3):
            x, y = places[view].numpy().astype(int).T
            inside = (x >= 0) & (x < record.cameras.width) & (y >= 0) & (y < record.cameras.height)
            assert inside.mean() > 0.9
            alpha = pixels[frame, view, y[inside], x[inside], 3]
            assert (alpha > 127).mean() > 0.9
            truth = sample.image(frame, view)
            both = (truth[..., 3] > solid) & (pixels[frame, view, ..., 3] > solid)
            assert both.sum() > 0.7 * (truth[..., 3] > solid).sum()
            assert np.abs(pixels[frame, view][both].astype(float) - truth[both]).mean() < tolerance


def torch_of(points: np.ndarray) -> Any:
    import torch

    return torch.from_numpy(points).float()


def test_synthetic_falls_of_spring_gaus(springgaus: Sample, tmp_path: Path) -> None:
    run = partial(import_springgaus.import_springgaus, springgaus.root, tmp_path / "out", SpringGausOptions())
    assert run()["made"] and not run()["made"] and verify(tmp_path / "out") == []
    data = ObjectData(tmp_path / "out")
    assert data.name == "torus" and data.fps == pytest.approx(1 / 0.03) and data.train_frames == range(20)
    assert data.views == ("camera_0", "camera_1", "camera_2") and data.heldout_views == ()
    assert data.facts["gravity"] == [0, -9.8, 0] and data.facts["free"] is True
    assert data.facts["floor"] == {"point": [0.0, 0.3, 0.0], "normal": [0.0, 1.0, 0.0]}
    check_views(data, springgaus, tolerance=1.0)
    # The lowest that the body ever is, is the floor; it falls as gravity says.
    lowest = (springgaus.path[..., 1] - springgaus.body.radii).min()
    assert lowest == pytest.approx(data.facts["floor"]["point"][1], abs=1e-6)
    stills = data.stills()
    np.testing.assert_array_equal(stills.images[1], data.sequences[0].frames(range(1))[0, 1])
    np.testing.assert_array_equal(stills.cameras.viewmats, data.sequences[0].cameras.viewmats)


def test_smaller_pictures_and_views_held_out(springgaus: Sample, tmp_path: Path) -> None:
    options = SpringGausOptions(longest=24, heldout=("camera_1",), train_frames=6, name="ring", fps=30)
    import_springgaus.import_springgaus(springgaus.root, tmp_path / "out", options)
    data = ObjectData(tmp_path / "out")
    assert (data.name, data.fps, data.train_frames, data.heldout_views) == ("ring", 30, range(6), ("camera_1",))
    assert len(data.stills().images) == 2  # what is held out is no still either
    assert data.sequences[0].cameras.width == 24
    half = Sample(springgaus.root, springgaus.rig, springgaus.path, springgaus.body)
    half.image = lambda f, v: cv2.resize(springgaus.image(f, v), (24, 24), interpolation=cv2.INTER_AREA)  # type: ignore[method-assign]
    check_views(data, half, tolerance=10.0)
    with pytest.raises(ConfigError, match="--heldout camera_7"):
        import_springgaus.import_springgaus(springgaus.root, tmp_path / "no", SpringGausOptions(heldout=("camera_7",)))


def test_real_captures_are_registered_by_silhouettes(
    real: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in SMALL.items():
        monkeypatch.setattr(registration, name, value)
    options = SpringGausOptions(object="bun", turns=150)
    results = import_springgaus.import_springgaus(real.root, tmp_path / "out", options)["results"]["objects"]["bun"]
    found = results["registration"]
    assert found["overlap"] > 0.8 and found["scale"] == pytest.approx(real.more["scale"], rel=0.06)
    rest = (real.path[0] - real.more["shift"]) / real.more["scale"] @ real.more["turn"]
    back = found["scale"] * rest @ np.array(found["rotation"]).T + found["shift"]
    size = np.linalg.norm(np.ptp(real.path[0], axis=0))
    assert np.sqrt(((back - real.path[0]) ** 2).sum(-1).mean()) < 0.04 * size
    data = ObjectData(tmp_path / "out")
    check_views(data, real)
    stills = read_stills(tmp_path / "out" / "static" / "transforms.json")
    places, _ = project(torch_of(real.path[0]), stills.cameras.viewmats, stills.cameras.Ks)
    x, y = places.numpy().astype(int).transpose(2, 0, 1)
    alpha = np.take_along_axis(stills.images[..., 3].numpy().reshape(14, -1), y * 108 + x, 1)
    assert (alpha > 127).mean() > 0.8  # points of the films, seen in the stills
    assert data.facts["gravity"] == [0, 0, 9.8] and data.facts["floor"]["normal"] == [0, 0, -1]
    assert data.train_frames == range(SEEN)
    with pytest.raises(GausSimError, match=r"overlap those of seq_000's first frame by 0\.8.*--no-stills"):
        refused = SpringGausOptions(object="bun", turns=150, least_overlap=0.99)
        import_springgaus.import_springgaus(real.root, tmp_path / "no", refused)


@pytest.mark.parametrize("kind", ["matted", "plate", "rgba"])
def test_falls_of_pac_nerf(kind: str, tmp_path: Path) -> None:
    sample = public_sets.write_pacnerf(tmp_path / "bird", kind=kind)
    import_pacnerf.import_pacnerf(sample.root, tmp_path / "out", PacNerfOptions())
    data = ObjectData(tmp_path / "out")
    assert data.fps == pytest.approx(24) and data.train_frames == range(FRAMES)
    assert data.facts["floor"]["point"] == [0, 0, 0] and data.facts["gravity"] == [0, -9.8, 0] and data.facts["free"]
    check_views(
        data, sample, tolerance={"matted": 3, "plate": 40, "rgba": 1}[kind], solid=127 if kind == "plate" else 250
    )
    assert (sample.path[..., 1] - sample.body.radii).min() == pytest.approx(0, abs=1e-6)
    if kind == "matted":
        alpha = data.sequences[0].frames(range(1)).numpy()[0, 0, ..., 3].astype(int)
        assert np.abs(alpha - sample.image(0, 0)[..., 3]).max() < 25  # half-covered pixels too


def test_coverage_before_white_and_before_a_plate() -> None:
    rng = np.random.default_rng(0)
    rgb, plate = rng.integers(0, 200, (2, 16, 16, 3))
    plate[:2] = 255  # where the plate is white it tells nothing
    alpha = np.linspace(0, 1, 256).reshape(16, 16, 1)
    matted, picture = (np.round(rgb * alpha + behind * (1 - alpha)).astype(np.uint8) for behind in (255, plate))
    found = before_white(matted, picture, plate.astype(np.uint8))
    assert np.abs(found[2:, ..., 3] / 255 - alpha[2:, ..., 0]).max() < 0.03
    solid = alpha[..., 0] > 0.5
    assert np.abs(found[solid][:, :3].astype(float) - rgb[solid]).max() < 12
    assert (found[:2, ..., 3] == np.where((matted[:2] == 255).all(-1), 0, 255)).all()


def test_hands_of_phystwin(phystwin: Sample, tmp_path: Path) -> None:
    results = import_phystwin.import_phystwin(phystwin.root, tmp_path / "out", PhysTwinOptions())["results"]
    notes = results["objects"][phystwin.root.name]["notes"]
    assert notes["hands"] == "12 points, 6 + 6" and notes["tracks"].startswith("4 of 5 ")
    data = ObjectData(tmp_path / "out")
    assert data.train_frames == range(SEEN) and data.fps == 30 and "free" not in data.facts
    assert data.facts["grip"] == 0.04 and data.facts["gravity"] == [0, 0, 9.8]
    assert data.facts["floor"] == {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, -1.0]}
    assert data.diagonal == pytest.approx(np.linalg.norm(np.ptp(phystwin.path[0], axis=0)))
    check_views(data, phystwin)
    with np.load(tmp_path / "out" / "sequences" / "seq_000" / "hands.npz") as hands:
        np.testing.assert_allclose(hands["points"], phystwin.more["hands"], atol=1e-6)
        assert hands["hand"].tolist() == [0, 1] * 6
    truth = data.ground_truth(data.sequences[0])
    assert truth is not None
    np.testing.assert_allclose(truth.positions, phystwin.more["tracks"][:, [0, 2, 3, 4]], atol=1e-6)
    pixels = data.sequences[0].frames(range(FRAMES)).numpy()
    assert (pixels[:, :, :, :6, 3] == 0).all()  # the human's pixels
    assert "look at" not in notes
    one = import_phystwin.import_phystwin(phystwin.root, tmp_path / "one", PhysTwinOptions(hands=1))["results"]
    assert "--hands" in one["objects"][phystwin.root.name]["notes"]["look at"]
    with np.load(tmp_path / "out" / "points.npz") as cloud:
        np.testing.assert_allclose(cloud["points"], phystwin.path[0], atol=1e-6)
        np.testing.assert_array_equal(cloud["colors"], phystwin.body.colors)


def test_points_that_stay_together_are_a_hand() -> None:
    rng = np.random.default_rng(1)
    # The hands meet in the middle of their ways: only the whole way tells them apart.
    ways = np.stack((np.linspace(-1, 1, 9), np.linspace(1, -1, 9)))[[0, 1, 1, 0, 1]]
    points = np.stack((ways, 0 * ways, 0 * ways), -1).transpose(1, 0, 2) + 0.02 * rng.standard_normal((5, 3))
    assert together(points[2:], 2).tolist() == [0, 1, 1, 0, 1] and together(points, 1).tolist() == [0] * 5


def test_samples_of_3dgsim_with_the_same_cameras_are_sequences(genesis: Sample, tmp_path: Path) -> None:
    import_3dgsim.import_3dgsim(genesis.root, tmp_path / "out", GenesisOptions(fps=25))
    data = ObjectData(tmp_path / "out")
    assert [record.name for record in data.sequences] == ["0001", "0002"] and data.train_frames == range(FRAMES)
    check_views(data, genesis)
    assert data.facts["floor"]["normal"] == [0, 0, 1] and data.facts["gravity"] == [0, 0, -9.81]
    first, second = (record.frames(range(1)).numpy()[0, 0] for record in data.sequences)
    assert (first[-3:, :, 3] == 0).all() and (second[-3:, :, 3] == 0).all()  # the static part
    options = GenesisOptions(fps=25, segments=(3,))
    import_3dgsim.import_3dgsim(genesis.root / "0001", tmp_path / "static", options)
    alone = ObjectData(tmp_path / "static").sequences[0].frames(range(1)).numpy()[0, 0]
    assert (alone[-3:, :, 3] == 255).all() and (alone[:-3, :, 3] == 0).all()


def test_samples_of_3dgsim_with_other_cameras_are_objects(tmp_path: Path) -> None:
    public_sets.write_3dgsim(tmp_path / "dog", samples=("1", "10"), moved="10")
    import_3dgsim.import_3dgsim(tmp_path / "dog", tmp_path / "out", GenesisOptions(fps=25, train_frames=8))
    objects = [ObjectData(tmp_path / "out" / f"dog_{i}") for i in (0, 1)]
    assert [[record.name for record in data.sequences] for data in objects] == [["1"], ["10"]]
    assert objects[1].train_frames == range(8)
    assert not (objects[0].sequences[0].cameras.viewmats == objects[1].sequences[0].cameras.viewmats).all()


def test_stills_and_a_film_of_physdreamer(physdreamer: Path, tmp_path: Path) -> None:
    options = PhysDreamerOptions(anchor=0.4)
    masks = physdreamer.parent / "video_masks"
    results = import_physdreamer.import_physdreamer(physdreamer, tmp_path / "out", options, video_masks=masks)[
        "results"
    ]
    assert results["without_alpha"] == [] and results["stills"] == 3 and results["sequences"] == {"seq_000": FRAMES}
    data = ObjectData(tmp_path / "out")
    assert (data.fps, data.views, data.train_frames) == (
        30,
        ("frame_00002",),
        range(16),
    ) and "gravity" not in data.facts
    stills = data.stills()
    np.testing.assert_allclose(data.sequences[0].cameras.viewmats[0], stills.cameras.viewmats[1], atol=1e-5)
    film, still = data.sequences[0].frames(range(1)).numpy()[0, 0], stills.images[1].numpy()
    np.testing.assert_array_equal(film[..., 3], still[..., 3])
    inside = still[..., 3] > 127
    assert np.abs(film[inside].astype(float) - still[inside]).mean() < 12  # the film's colours are coded
    scene = load_scene(tmp_path / "out" / "scene.ply")
    z = scene.means[:, 2].numpy()
    # Moving: above 0.5; pinned: the layer below, 0.35 away.
    assert scene.simulated.tolist() == (z > 0.2).tolist() and scene.pinned.tolist() == ((z > 0.2) & (z < 0.5)).tolist()
    results = import_physdreamer.import_physdreamer(physdreamer, tmp_path / "bare", options)["results"]
    assert results["without_alpha"] == ["seq_000"]


def test_frames_in_place_of_a_film(physdreamer: Path, tmp_path: Path) -> None:
    root = tmp_path / "hat"
    shutil.copytree(physdreamer, root)
    (root / "videos" / "frame_00002_poke.mp4").unlink()
    for frame in range(4):
        public_sets.save(root / "videos" / f"{frame}.png", np.full((32, 32, 3), 60 * frame, np.uint8))
    run = partial(import_physdreamer.import_physdreamer, root, tmp_path / "out")
    with pytest.raises(ConfigError, match="--view and --fps"):
        run(PhysDreamerOptions(anchor=0.4))
    results = run(PhysDreamerOptions(anchor=0.4, view="frame_00003", fps=25))["results"]
    assert results["facts"]["views"] == ["frame_00003"] and results["facts"]["train_frames"] == [0, 4]
    assert results["facts"]["fps"] == 25 and results["sequences"] == {"seq_000": 4}


@pytest.mark.slow
def test_a_body_that_turns_onto_itself_is_ambiguous(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in SMALL.items():
        monkeypatch.setattr(registration, name, value)
    plain = public_sets.bar()
    plain.colors[:] = 150
    monkeypatch.setattr(public_sets, "dog", lambda scale: plain)
    sample = public_sets.write_springgaus_real(tmp_path / "real")
    options = SpringGausOptions(object="bun", turns=150, least_overlap=0)
    made = import_springgaus.import_springgaus(sample.root, tmp_path / "out", options)["results"]["objects"]["bun"]
    assert made["notes"]["look at"].startswith("another turn")


def test_the_command_that_trains_fits_the_frames() -> None:
    with (Path(__file__).parents[2] / "conf" / "data" / "object.yaml").open() as file:
        assert yaml.safe_load(file)["curriculum"]["t_max"] == CURRICULUM
    long, short = ({"train_frames": [0, n], "name": "duck"} for n in (CURRICULUM + 1, CURRICULUM))
    assert train_command(long, Path("out")) == "gausim train data=object data.root=out name=duck"
    assert " data.curriculum.t_max=14 " in train_command(short, Path("out"))


@dataclass(frozen=True)
class Damage:
    """One fault, in one file of a sample."""

    file: str  # within the sample
    change: Callable[[Any], Any] | None  # of its content: what JSON, a pickle or a picture holds; None removes it
    told: str  # what the message has to name besides the file
    named: str | None = None  # the file in the message, where it is not this one


def put(*keys: Any, to: Any) -> Callable[[Any], Any]:
    def change(data: Any) -> Any:
        *above, last = keys
        place = data
        for key in above:
            place = place[key]
        place[last] = to(place[last]) if callable(to) else to
        return data

    return change


def drop(*keys: Any) -> Callable[[Any], Any]:
    def change(data: Any) -> Any:
        *above, last = keys
        place = data
        for key in above:
            place = place[key]
        del place[last]
        return data

    return change


def narrow(pixels: np.ndarray) -> np.ndarray:
    return pixels[:, :-8]


def black(pixels: np.ndarray) -> np.ndarray:
    return 0 * pixels


class Canary:
    """Would leave a folder behind if it were unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        import os

        return os.mkdir, (str(self.path),)


def times(factor: float) -> Callable[[list], list]:
    return lambda rows: (factor * np.array(rows)).tolist()


SPRINGGAUS = (
    Damage("camera.json", None, "camera.json"),
    Damage("camera.json", lambda data: {"camera": 1}, "list of cameras"),
    Damage("camera.json", drop(1, "K"), "field 'K'"),
    Damage("camera.json", put(1, "K", to=[[1, 0, 2], [0, 1, 2]]), "field 'K'"),
    Damage("camera.json", put(1, "K", 0, 0, to=-5.0), "field 'K'"),
    Damage("camera.json", put(2, "c2w", to=times(2)), "field 'c2w'"),
    Damage("camera.json", put(2, "c2w", 0, 3, to=1e300), "field 'c2w'"),
    Damage("camera.json", put(2, "c2w", 0, to=["a", "b"]), "field 'c2w'"),
    Damage("camera.json", put(0, "camera", to="../x"), "field 'camera'"),
    Damage("camera.json", put(0, "camera", to="camera_1"), "field 'camera' 'camera_1' stands twice"),
    Damage("camera.json", put(0, "camera", to="camera_9"), "camera_9", "camera_9"),
    Damage("camera_0/003.png", None, "frame 3 is missing", "camera_0"),
    Damage("camera_2/023.png", None, "times of 24 frames, the folders have 23", "frame.json"),
    Damage("camera_0/001.png", lambda pixels: pixels[..., :3], "no transparent pixel"),
    Damage("camera_0/001.png", narrow, "is 40x48"),
    Damage("frame.json", put(3, to={"003": 0.5}), "rise by equal steps"),
    Damage("frame.json", drop(3), "times of 23 frames"),
    Damage("frame.json", put(3, to={"003": "x"}), "expected 'float'"),
)
REAL_FILES = (
    Damage("dynamic/cameras_calib.json", drop("C0733", "tvecs"), "field 'tvecs'"),
    Damage("dynamic/cameras_calib.json", put("C0733", "rvecs", to=[0, 0, 0, 1]), "field 'rvecs'"),
    Damage("dynamic/cameras_calib.json", drop("C0787"), "C0787", "0.json"),
    Damage("dynamic/cameras_calib.json", lambda data: [], "expected an object of cameras"),
    Damage("dynamic/sequences/bun/0.json", drop("hit_frame"), "field 'hit_frame'"),
    Damage("dynamic/sequences/bun/0.json", drop("C0801"), "C0801"),
    Damage("dynamic/sequences/bun/0.json", put("C0733", 0, to="../../x.jpg"), "field 'C0733'"),
    Damage("dynamic/sequences/bun/0.json", put("C0733", 0, to="x.jpg"), "field 'C0733': names a frame without"),
    Damage("dynamic/sequences/bun/0.json", drop("C0787", 3), "different numbers of frames"),
    Damage("dynamic/sequences/bun/0.json", None, "no sequence here", "bun"),
    Damage("dynamic/videos_masks/C0733/100.png", None, "0.json: field 'C0733'"),
    Damage("dynamic/videos_masks/C0733/100.png", narrow, "the mask of 100.jpg of 96x54"),
    Damage("dynamic/videos_images/C0733/101.jpg", None, "0.json: field 'C0733'"),
    Damage("static/colmap/bun/images.bin", lambda data: data[:-9], "truncated"),
)
STILLS = (
    Damage("static/masks/bun/DSC003.png", None, "no such file"),
    Damage("static/images/bun/DSC003.JPG", None, "no such photo"),
    Damage("static/masks/bun/DSC003.png", black, "have no common body", "static/masks/bun"),
    Damage("static/masks/bun/DSC003.png", narrow, "another shape"),
    Damage("dynamic/videos_masks/C0733/100.png", black, "the mask is empty"),
)
PACNERF = (
    Damage("all_data.json", lambda data: {}, "expected a list of images"),
    Damage("all_data.json", put(3, "file_path", to="./data/x_0_3.png"), "field 'file_path'"),
    Damage("all_data.json", put(3, "file_path", to="./../../r_0_3.png"), "field 'file_path'"),
    Damage("all_data.json", put(3, "file_path", to="./data/r_0_2.png"), "stands twice"),
    Damage("all_data.json", put(3, "c2w", to=[[1, 0, 0, 0]]), "field 'c2w'"),
    Damage("all_data.json", put(29, "c2w", 0, 3, to=lambda x: x + 0.1), "field 'c2w' differs"),
    Damage("all_data.json", put(29, "intrinsic", 0, 0, to=70.0), "field 'intrinsic' differs"),
    Damage("all_data.json", put(25, "intrinsic", 0, 1, to=30.0), "field 'intrinsic'"),
    Damage("all_data.json", lambda data: [put("intrinsic", 0, 2, to=40.0)(d) for d in data], "picture of 80x64"),
    Damage("all_data.json", drop(3, "time"), "field 'time'"),
    Damage("all_data.json", put(3, "time", to=0.9), "field 'time'"),
    Damage("all_data.json", drop(3), "frame 3 is missing"),
    Damage("data/r_0_-1.png", None, "frame -1"),
    Damage("data/r_1_-1.png", narrow, "the empty scene of 64x64"),
    Damage("data/m_0_2.png", None, "not found, or not a file"),
    Damage("data/m_0_2.png", narrow, "is 56x64"),
    Damage("data/r_1_-2.png", narrow, "pixels to ignore"),
)
PHYSTWIN = (
    Damage("metadata.json", drop("intrinsics"), "field 'intrinsics'"),
    Damage("metadata.json", put("intrinsics", 1, 1, 1, to=0), "field 'intrinsics'[1]"),
    Damage("metadata.json", put("frame_num", to=25), "field 'frame_num' is 25", "color/0/24.png"),
    Damage("metadata.json", put("frame_num", to=-1), "field 'frame_num'"),
    Damage("metadata.json", put("WH", to=[848, 480]), "field 'WH'"),
    Damage("calibrate.pkl", lambda data: data[:2], "list of 3 poses"),
    Damage("calibrate.pkl", put(1, slice(0, 3), to=lambda m: m * 1.5), "[1]: expected a rotation"),
    Damage("calibrate.pkl", put(1, to="x"), "[1]: expected"),
    Damage("calibrate.pkl", put(0, to=Canary(Path("canary"))), "posix.mkdir"),
    Damage("final_data.pkl", lambda data: np.array([{}], dtype=object), "elements of type 'O8'"),
    Damage("final_data.pkl", lambda data: [1], "expected a dict"),
    Damage("final_data.pkl", drop("controller_points"), "field 'controller_points' is missing"),
    Damage("final_data.pkl", put("controller_points", to=lambda x: x[1:]), "field 'controller_points'"),
    Damage("final_data.pkl", put("controller_points", 3, 0, 0, to=np.nan), "field 'controller_points'"),
    Damage("final_data.pkl", put("object_points", to=lambda x: x > 0), "field 'object_points'"),
    Damage("gt_track_3d.pkl", lambda data: data[:, :, :2], "shape (24, points, 3)"),
    Damage("gt_track_3d.pkl", lambda data: data.tolist(), "got a list"),
    Damage("split.json", put("test", to=[15, 24]), "'train' [0, n]"),
    Damage("split.json", None, "no such file"),
    Damage("mask/mask_info_1.json", put("7", to="bear"), "expected one mask"),
    Damage(
        "mask/mask_info_1.json",
        lambda data: {"2": "sloth", **dict.fromkeys(map(str, range(20, 40)), "hand")},
        "20 hands",
    ),
    Damage("mask/mask_info_1.json", lambda data: ["hand"], "expected 'object'"),
    Damage("mask/1/2/0.png", None, "not found, or not a file"),
    Damage("mask/0/1/0.png", narrow, "the mask of 0.png of 64x36"),
    Damage("../../different_types_human_mask/double_stretch_sloth/mask/0/0/3.png", None, "not found", "mask/0/0/3.png"),
)
GENESIS = (
    Damage("0001/metadata.json", put("n_steps", to="many"), "field 'n_steps'"),
    Damage("0001/metadata.json", put("n_steps", to=25), "rgb_0024.png", "0001"),
    Damage("0001/metadata.json", put("n_cams", to=4), "field 'cam_3'"),
    Damage("0001/metadata.json", put("file_path_template", to="cam_{cam_ix}/{n_step}"), "field 'file_path_template'"),
    Damage(
        "0001/metadata.json",
        put("file_path_template", to="{cam_ix.real}{n_step}{img_type}"),
        "field 'file_path_template'",
    ),
    Damage(
        "0001/metadata.json",
        put("file_path_template", to="{cam_ix}{n_step:99999999d}{img_type}"),
        "field 'file_path_template'",
    ),
    Damage(
        "0001/metadata.json",
        put("file_path_template", to="../{cam_ix}{n_step}{img_type}"),
        "field 'file_path_template'",
    ),
    Damage(
        "0001/metadata.json", put("file_path_template", to="{cam_ix}{n_step}{img_type"), "field 'file_path_template'"
    ),
    Damage("0001/metadata.json", put("cam_1", "extrinsics", to=times(-1)), "field 'cam_1.extrinsics'"),
    Damage("0001/metadata.json", put("cam_1", "intrinsics", 2, 2, to=2), "field 'cam_1.intrinsics'"),
    Damage("0001/metadata.json", put("cam_1", "resolution", to=[48]), "field 'cam_1': field 'resolution'"),
    Damage("0001/metadata.json", put("cam_1", "resolution", to=[64, 48]), "is 48x48", "cam_1"),
    Damage("0001/cam_0/rgb_0003.png", None, "not found, or not a file"),
    Damage("0001/cam_2/seg_0003.png", None, "not found, or not a file"),
    Damage("0001/cam_0/seg_0000.png", lambda p: np.dstack([p, p // 2, p]), "one number per pixel"),
    Damage("0001/cam_0/seg_0000.png", lambda p: b"nonsense", "no picture"),
)
PHYSDREAMER = (
    Damage("sparse/0/images.bin", lambda data: data[:-9], "truncated"),
    Damage("images/frame_00003.png", None, "no such file"),
    Damage("images/frame_00003.png", narrow, "another shape"),
    Damage("point_cloud.ply", None, "no such file"),
    Damage("point_cloud.ply", lambda data: data[:200], "point_cloud.ply"),
    Damage("moving_part_points.ply", lambda data: data[:40], "moving_part_points.ply"),
    Damage("moving_part_points.ply", lambda data: data.replace(b"-0.29", b"nan"), "moving_part_points.ply"),
    Damage("videos/frame_00002_poke.mp4", lambda data: data[:300], "frame_00002_poke.mp4"),
    Damage("videos/frame_00002_poke.mp4", None, "no images here", "videos"),
    Damage("masks/frame_00002_mask.png", narrow, "is 24x32"),
    Damage("../video_masks/0003.png", None, "no mask of the frame", "0003.png"),
    Damage("../video_masks/0000.png", narrow, "is 24x32", "0000.png"),
)


def harm(path: Path, change: Callable[[Any], Any] | None) -> None:
    """Damages a file by what it holds."""
    if change is None:
        path.unlink()
    elif path.suffix == ".json":
        path.write_text(json.dumps(change(json.loads(path.read_bytes()))))
    elif path.suffix == ".pkl":
        path.write_bytes(pickle.dumps(change(pickle.loads(path.read_bytes()))))
    elif path.suffix in (".png", ".jpg", ".JPG"):
        pixels = change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        if isinstance(pixels, bytes):
            path.write_bytes(pixels)
        else:
            assert cv2.imwrite(str(path), pixels)
    else:
        path.write_bytes(change(path.read_bytes()))


def check_refused(root: Path, damage: Damage, run: Callable[[Path], object], folder: Path) -> None:
    path = (root / damage.file).resolve()
    good = path.read_bytes()
    try:
        harm(path, damage.change)
        assert not path.exists() or path.read_bytes() != good, "the damage changes nothing"
        with pytest.raises(GausSimError) as caught:
            run(folder / "out")
    finally:
        path.write_bytes(good)
    text = str(caught.value)
    assert damage.told in text and (damage.named or path.name) in text, text
    assert not (folder / "out").exists() and not Path("canary").exists()


def ids(damages: tuple[Damage, ...]) -> list[str]:
    return [f"{Path(damage.file).name}: {damage.told}" for damage in damages]


@pytest.mark.parametrize("damage", SPRINGGAUS, ids=ids(SPRINGGAUS))
def test_damaged_synthetic_falls_are_refused(damage: Damage, springgaus: Sample, tmp_path: Path) -> None:
    run = partial(import_springgaus.import_springgaus, springgaus.root, options=SpringGausOptions())
    check_refused(springgaus.root, damage, run, tmp_path)


@pytest.mark.parametrize("damage", (*REAL_FILES, *STILLS), ids=ids((*REAL_FILES, *STILLS)))
def test_damaged_real_captures_are_refused(damage: Damage, real: Sample, tmp_path: Path) -> None:
    options = REAL if damage in REAL_FILES else SpringGausOptions(object="bun", turns=1)
    check_refused(real.root, damage, partial(import_springgaus.import_springgaus, real.root, options=options), tmp_path)


@pytest.mark.parametrize("damage", PACNERF, ids=ids(PACNERF))
def test_damaged_falls_of_pac_nerf_are_refused(damage: Damage, pacnerf: Sample, tmp_path: Path) -> None:
    run = partial(import_pacnerf.import_pacnerf, pacnerf.root, options=PacNerfOptions())
    check_refused(pacnerf.root, damage, run, tmp_path)


@pytest.mark.parametrize("damage", PHYSTWIN, ids=ids(PHYSTWIN))
def test_damaged_cases_of_phystwin_are_refused(damage: Damage, phystwin: Sample, tmp_path: Path) -> None:
    run = partial(import_phystwin.import_phystwin, phystwin.root, options=PhysTwinOptions())
    check_refused(phystwin.root, damage, run, tmp_path)


@pytest.mark.parametrize("damage", GENESIS, ids=ids(GENESIS))
def test_damaged_samples_of_3dgsim_are_refused(damage: Damage, genesis: Sample, tmp_path: Path) -> None:
    run = partial(import_3dgsim.import_3dgsim, genesis.root, options=GenesisOptions(fps=25))
    check_refused(genesis.root, damage, run, tmp_path)


@pytest.mark.parametrize("damage", PHYSDREAMER, ids=ids(PHYSDREAMER))
def test_damaged_captures_of_physdreamer_are_refused(damage: Damage, physdreamer: Path, tmp_path: Path) -> None:
    masks = physdreamer.parent / "video_masks"
    options = PhysDreamerOptions(anchor=0.4)
    run = partial(import_physdreamer.import_physdreamer, physdreamer, options=options, video_masks=masks)
    check_refused(physdreamer, damage, run, tmp_path)


def test_two_sequences_of_one_name_are_refused(real: Sample, tmp_path: Path) -> None:
    path = real.root / "dynamic" / "sequences" / "bun" / "00.json"
    shutil.copyfile(path.with_name("0.json"), path)
    try:
        with pytest.raises(GausSimError, match="two sequences would get the name 'seq_000'"):
            import_springgaus.import_springgaus(real.root, tmp_path / "out", REAL)
    finally:
        path.unlink()


def test_options_that_do_not_suit_the_folder(
    springgaus: Sample,
    real: Sample,
    phystwin: Sample,
    genesis: Sample,
    physdreamer: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = (
        (import_springgaus, springgaus.root, "--object bun", "--object"),
        (import_springgaus, real.root, "--object cat", "['bun']"),
        (import_springgaus, tmp_path, "", "camera.json"),
        (import_springgaus, springgaus.root, "--train-frames 30", "24 frames, fewer than the 30"),
        (import_3dgsim, genesis.root, "", "--fps"),
        (import_3dgsim, tmp_path, "--fps 25", "metadata.json"),
        (import_pacnerf, tmp_path, "", "all_data.json"),
        (import_phystwin, tmp_path, "", "metadata.json"),
        (import_phystwin, phystwin.root, "--hands 2 --human-masks nowhere", "--human-masks"),
        (import_physdreamer, tmp_path, "", "no COLMAP model"),
        (import_physdreamer, physdreamer, "--view frame_9", "frame_00001"),
        (import_physdreamer, physdreamer, "", "--anchor"),
        (import_physdreamer, physdreamer, "--train-frames 30", "24 frames, fewer than the 30"),
        (import_physdreamer, physdreamer, "--video-masks nowhere", "--video-masks"),
    )
    for module, root, line, told in lines:
        assert module.main([str(root), "--out", str(tmp_path / "out"), *line.split()]) == 2
        assert told in capsys.readouterr().err, (module.__name__, line)
