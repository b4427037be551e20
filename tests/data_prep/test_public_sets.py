"""Public sets become ours: the poses show the true points, the world is the right one, damaged files are refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers import public_sets
from helpers.public_sets import FRAMES, SEEN, Sample

from data_prep.common.objects import train_command
from data_prep.import_3dgsim import GenesisOptions, import_3dgsim
from data_prep.import_pacnerf import PacNerfOptions, import_pacnerf
from data_prep.import_physdreamer import PhysDreamerOptions, import_physdreamer
from data_prep.import_physdreamer import main as main_of_physdreamer
from data_prep.import_phystwin import PhysTwinOptions, import_phystwin, together
from data_prep.import_springgaus import SpringGausOptions, import_springgaus
from data_prep.public import registration
from data_prep.public.pictures import before_white
from gausim.core import ConfigError, GausSimError
from gausim.data.objects import ObjectData
from gausim.data.records import read_stills
from gausim.data.verify import verify
from gausim.io.ply import load_scene
from gausim.ops.visual_hull import project

SampleOf = Callable[[str], Any]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A registration of little work."""
    for name, value in {"REFINED": 4, "VOXELS": 40, "REFINEMENT_STEPS": 150}.items():
        monkeypatch.setattr(registration, name, value)


def check_views(data: ObjectData, sample: Sample, *, tolerance: float = 40.0, solid: int = 250) -> None:
    """Every ball is seen at its true place in every view of the first, a middle and the last frame."""
    record = data.sequences[-1]
    pixels = record.frames(range(record.count)).numpy()
    assert record.count == FRAMES and pixels.shape[1] == 3
    for frame in (0, 9, FRAMES - 1):
        points = np.concatenate((sample.path[frame], sample.path[frame] + 0.3 * sample.body.radii[:, None]))
        places, _ = project(torch.from_numpy(points).float(), record.cameras.viewmats, record.cameras.Ks)
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


def test_synthetic_falls_of_spring_gaus(sample_of: SampleOf, tmp_path: Path) -> None:
    springgaus = sample_of("springgaus")
    run = partial(import_springgaus, springgaus.root, tmp_path / "out", SpringGausOptions())
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


def test_smaller_pictures_and_views_held_out(sample_of: SampleOf, tmp_path: Path) -> None:
    springgaus = sample_of("springgaus")
    options = SpringGausOptions(longest=24, heldout=("camera_1",), train_frames=6, name="ring", fps=30)
    import_springgaus(springgaus.root, tmp_path / "out", options)
    data = ObjectData(tmp_path / "out")
    assert (data.name, data.fps, data.train_frames, data.heldout_views) == ("ring", 30, range(6), ("camera_1",))
    assert len(data.stills().images) == 2  # what is held out is no still either
    assert data.sequences[0].cameras.width == 24
    half = Sample(springgaus.root, springgaus.rig, springgaus.path, springgaus.body)
    half.image = lambda f, v: cv2.resize(springgaus.image(f, v), (24, 24), interpolation=cv2.INTER_AREA)  # type: ignore[method-assign]
    check_views(data, half, tolerance=10.0)
    with pytest.raises(ConfigError, match="--heldout camera_7"):
        import_springgaus(springgaus.root, tmp_path / "no", SpringGausOptions(heldout=("camera_7",)))


def test_real_captures_are_registered_by_silhouettes(sample_of: SampleOf, small: None, tmp_path: Path) -> None:
    real = sample_of("real")
    options = SpringGausOptions(object="bun", turns=150)
    results = import_springgaus(real.root, tmp_path / "out", options)["results"]["objects"]["bun"]
    found = results["registration"]
    assert found["overlap"] > 0.8 and found["scale"] == pytest.approx(real.more["scale"], rel=0.06)
    rest = (real.path[0] - real.more["shift"]) / real.more["scale"] @ real.more["turn"]
    back = found["scale"] * rest @ np.array(found["rotation"]).T + found["shift"]
    size = np.linalg.norm(np.ptp(real.path[0], axis=0))
    assert np.sqrt(((back - real.path[0]) ** 2).sum(-1).mean()) < 0.04 * size
    data = ObjectData(tmp_path / "out")
    check_views(data, real)
    stills = read_stills(tmp_path / "out" / "static" / "transforms.json")
    places, _ = project(torch.from_numpy(real.path[0]).float(), stills.cameras.viewmats, stills.cameras.Ks)
    x, y = places.numpy().astype(int).transpose(2, 0, 1)
    alpha = np.take_along_axis(stills.images[..., 3].numpy().reshape(14, -1), y * 108 + x, 1)
    assert (alpha > 127).mean() > 0.8  # points of the films, seen in the stills
    assert data.facts["gravity"] == [0, 0, 9.8] and data.facts["floor"]["normal"] == [0, 0, -1]
    assert data.train_frames == range(SEEN)
    with pytest.raises(GausSimError, match=r"overlap those of seq_000's first frame by 0\.8.*--no-stills"):
        refused = SpringGausOptions(object="bun", turns=150, least_overlap=0.99)
        import_springgaus(real.root, tmp_path / "no", refused)


@pytest.mark.parametrize("kind", ["matted", "plate", "rgba"])
def test_falls_of_pac_nerf(kind: str, tmp_path: Path) -> None:
    sample = public_sets.write_pacnerf(tmp_path / "bird", kind=kind)
    import_pacnerf(sample.root, tmp_path / "out", PacNerfOptions())
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


def test_hands_of_phystwin(sample_of: SampleOf, tmp_path: Path) -> None:
    phystwin = sample_of("phystwin")
    results = import_phystwin(phystwin.root, tmp_path / "out", PhysTwinOptions())["results"]
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
    one = import_phystwin(phystwin.root, tmp_path / "one", PhysTwinOptions(hands=1))["results"]
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


def test_samples_of_3dgsim_with_the_same_cameras_are_sequences(sample_of: SampleOf, tmp_path: Path) -> None:
    genesis = sample_of("genesis")
    import_3dgsim(genesis.root, tmp_path / "out", GenesisOptions(fps=25))
    data = ObjectData(tmp_path / "out")
    assert [record.name for record in data.sequences] == ["0001", "0002"] and data.train_frames == range(FRAMES)
    check_views(data, genesis)
    assert data.facts["floor"]["normal"] == [0, 0, 1] and data.facts["gravity"] == [0, 0, -9.81]
    first, second = (record.frames(range(1)).numpy()[0, 0] for record in data.sequences)
    assert (first[-3:, :, 3] == 0).all() and (second[-3:, :, 3] == 0).all()  # the static part
    options = GenesisOptions(fps=25, segments=(3,))
    import_3dgsim(genesis.root / "0001", tmp_path / "static", options)
    alone = ObjectData(tmp_path / "static").sequences[0].frames(range(1)).numpy()[0, 0]
    assert (alone[-3:, :, 3] == 255).all() and (alone[:-3, :, 3] == 0).all()


def test_samples_of_3dgsim_with_other_cameras_are_objects(tmp_path: Path) -> None:
    public_sets.write_3dgsim(tmp_path / "dog", samples=("1", "10"), moved="10")
    import_3dgsim(tmp_path / "dog", tmp_path / "out", GenesisOptions(fps=25, train_frames=8))
    objects = [ObjectData(tmp_path / "out" / f"dog_{i}") for i in (0, 1)]
    assert [[record.name for record in data.sequences] for data in objects] == [["1"], ["10"]]
    assert objects[1].train_frames == range(8)
    assert not (objects[0].sequences[0].cameras.viewmats == objects[1].sequences[0].cameras.viewmats).all()


def test_stills_and_a_film_of_physdreamer(sample_of: SampleOf, tmp_path: Path) -> None:
    physdreamer = sample_of("physdreamer").root
    options, masks = PhysDreamerOptions(anchor=0.4), physdreamer.parent / "video_masks"
    results = import_physdreamer(physdreamer, tmp_path / "out", options, video_masks=masks)["results"]
    assert results["without_alpha"] == [] and results["stills"] == 3 and results["sequences"] == {"seq_000": FRAMES}
    data = ObjectData(tmp_path / "out")
    assert (data.fps, data.views, data.train_frames) == (30, ("frame_00002",), range(16))
    assert "gravity" not in data.facts
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
    results = import_physdreamer(physdreamer, tmp_path / "bare", options)["results"]
    assert results["without_alpha"] == ["seq_000"]


def test_frames_in_place_of_a_film(sample_of: SampleOf, tmp_path: Path) -> None:
    physdreamer = sample_of("physdreamer").root
    root = tmp_path / "hat"
    shutil.copytree(physdreamer, root)
    (root / "videos" / "frame_00002_poke.mp4").unlink()
    for frame in range(4):
        public_sets.save(root / "videos" / f"{frame}.png", np.full((32, 32, 3), 60 * frame, np.uint8))
    run = partial(import_physdreamer, root, tmp_path / "out")
    with pytest.raises(ConfigError, match="--view and --fps"):
        run(PhysDreamerOptions(anchor=0.4))
    results = run(PhysDreamerOptions(anchor=0.4, view="frame_00003", fps=25))["results"]
    assert results["facts"]["views"] == ["frame_00003"] and results["facts"]["train_frames"] == [0, 4]
    assert results["facts"]["fps"] == 25 and results["sequences"] == {"seq_000": 4}


@pytest.mark.slow
def test_a_body_that_turns_onto_itself_is_ambiguous(
    small: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = public_sets.bar()
    plain.colors[:] = 150
    monkeypatch.setattr(public_sets, "dog", lambda scale: plain)
    sample = public_sets.write_springgaus_real(tmp_path / "real")
    options = SpringGausOptions(object="bun", turns=150, least_overlap=0)
    made = import_springgaus(sample.root, tmp_path / "out", options)["results"]["objects"]["bun"]
    assert made["notes"]["look at"].startswith("another turn")


def test_the_command_that_trains_fits_the_frames() -> None:
    assert train_command("duck", Path("out")) == "gausim train data=object data.root=out name=duck"


def test_two_sequences_of_one_name_are_refused(sample_of: SampleOf, tmp_path: Path) -> None:
    real = sample_of("real")
    path = real.root / "dynamic" / "sequences" / "bun" / "00.json"
    shutil.copyfile(path.with_name("0.json"), path)
    try:
        with pytest.raises(GausSimError, match="two sequences would get the name 'seq_000'"):
            import_springgaus(real.root, tmp_path / "out", SpringGausOptions(object="bun", no_stills=True))
    finally:
        path.unlink()


def test_options_that_do_not_suit_the_folder(
    sample_of: SampleOf, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ("springgaus", "real", "phystwin", "genesis", "physdreamer")
    torus, real, sloth, dog, hat = (sample_of(name).root for name in names)
    lines = (
        (import_springgaus.main, torus, "--object bun", "--object"),
        (import_springgaus.main, real, "--object cat", "['bun']"),
        (import_springgaus.main, tmp_path, "", "camera.json"),
        (import_springgaus.main, torus, "--train-frames 30", "24 frames, fewer than the 30"),
        (import_3dgsim.main, dog, "", "--fps"),
        (import_3dgsim.main, tmp_path, "--fps 25", "metadata.json"),
        (import_pacnerf.main, tmp_path, "", "all_data.json"),
        (import_phystwin.main, tmp_path, "", "metadata.json"),
        (import_phystwin.main, sloth, "--hands 2 --human-masks nowhere", "--human-masks"),
        (main_of_physdreamer, tmp_path, "", "no COLMAP model"),
        (main_of_physdreamer, hat, "--view frame_9", "frame_00001"),
        (main_of_physdreamer, hat, "", "--anchor"),
        (main_of_physdreamer, hat, "--train-frames 30", "24 frames, fewer than the 30"),
        (main_of_physdreamer, hat, "--video-masks nowhere", "--video-masks"),
    )
    for command, root, line, told in lines:
        assert command([str(root), "--out", str(tmp_path / "out"), *line.split()]) == 2
        assert told in capsys.readouterr().err, (root, line)
