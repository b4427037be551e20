"""Results of the stages become one object that is complete and right; from films and photos to training by one file."""

import json
import shutil
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from helpers import toy_object
from helpers.plain import edit_json

from data_prep import ingest, pack, poses, segment, select
from data_prep.assemble import AssembleOptions, assemble, main
from gausim.core import Cameras, ConfigError, DataError
from gausim.data.datamodule import ReadyDataModule
from gausim.data.images import read_rgba, write_rgba
from gausim.data.objects import ObjectData
from gausim.data.verify import verify
from gausim.io.ply import save_scene
from gausim.io.transforms import write_transforms
from gausim.training.plan import TrainingPlan

GREEN = np.array([0, 177, 64], np.uint8)
RATE = Fraction(24)


def add_stills(toy: Any, folder: Path) -> None:
    """Posed RGBA stills of the rest state, as `segment` leaves them."""
    images = toy_object.rgba(toy.scene, toy.truth("seq_000", 1))[0]
    entries = []
    for view, pixels in zip(toy.views.names, images, strict=True):
        (folder / "images").mkdir(parents=True, exist_ok=True)
        write_rgba(folder / "images" / f"{view}.png", pixels)
        entries.append({"file_path": f"images/{view}.png"})
    write_transforms(folder / "transforms.json", toy.views, entries)


@pytest.fixture
def toy(tmp_path: Path) -> Any:
    """What `segment` leaves: stills and sequences with poses, no dataset.json; the scene apart."""
    found = toy_object.write_toy_object(tmp_path / "cut", frames=9)
    add_stills(found, tmp_path / "cut")
    (tmp_path / "scene").mkdir()
    for name in ("scene.ply", "scene.masks.npz"):
        (tmp_path / "cut" / name).rename(tmp_path / "scene" / name)
    (tmp_path / "cut" / "dataset.json").unlink()
    (tmp_path / "cut" / "rest_points.npz").unlink()
    return found


def test_an_object_is_complete_and_right(toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "flower"
    assert main([str(toy.root), "--out", str(out), "--scene", str(tmp_path / "scene"), "--train-frames", "5"]) == 0
    text = capsys.readouterr().out
    assert "train cam_0, cam_1; never trained on: cam_2" in text and f"data={out}" in text
    assert verify(out) == []
    data = ObjectData(out)
    assert data.name == "flower" and data.fps == 24 and data.train_frames == range(5)
    assert data.train_views == ("cam_0", "cam_1") and data.heldout_views == ("cam_2",)
    assert [s.name for s in data.sequences] == ["seq_000", "seq_001"] and len(data.stills().images) == 3
    assert torch.equal(data.scene().pinned, toy.scene.pinned)
    truth = read_rgba(toy.root / "sequences" / "seq_001" / "cam_2" / "0007.png", (32, 32))
    assert np.array_equal(data.sequences[1].frames(range(7, 8), ["cam_2"])[0, 0].numpy(), truth)
    assert assemble([toy.root], out, AssembleOptions(train_frames=5), scene=tmp_path / "scene")["made"] is False


def test_without_a_scene_it_is_what_reconstruct_needs(toy: Any, tmp_path: Path) -> None:
    results = assemble([toy.root], tmp_path / "out")["results"]
    assert results["scene"] is False and results["stills"] == 3 and results["sequences"] == {"seq_000": 9, "seq_001": 9}
    assert verify(tmp_path / "out") == []
    assert ObjectData(tmp_path / "out").train_frames == range(9)  # shorter than the usual 16


def test_a_later_folder_replaces_what_an_earlier_one_has(toy: Any, tmp_path: Path) -> None:
    films = tmp_path / "films"
    shutil.copytree(toy.root / "sequences" / "seq_001", films / "seq_001")
    pixels = np.zeros((32, 32, 4), np.uint8)
    pixels[8:20, 8:20] = 255
    write_rgba(films / "seq_001" / "cam_0" / "0003.png", torch.from_numpy(pixels))
    assemble([toy.root, films], tmp_path / "out")
    first, second = ObjectData(tmp_path / "out").sequences
    assert np.array_equal(second.frames(range(3, 4), ["cam_0"])[0, 0].numpy(), pixels)
    assert not np.array_equal(first.frames(range(3, 4), ["cam_0"])[0, 0].numpy(), pixels)


def test_facts_beside_the_pictures_are_kept_and_options_win(toy: Any, tmp_path: Path) -> None:
    facts = {"name": "orchid", "heldout_views": ["cam_0"], "train_frames": [0, 6], "train_sequences": ["seq_000"]}
    (toy.root / "dataset.json").write_text(json.dumps(facts))
    found = assemble([toy.root], tmp_path / "a")["results"]["facts"]
    assert found["name"] == "orchid" and found["train_views"] == ["cam_1", "cam_2"] and found["train_frames"] == [0, 6]
    assert found["train_sequences"] == ["seq_000"]
    options = AssembleOptions(name="rose", heldout=(), train_frames=4)
    found = assemble([toy.root], tmp_path / "b", options)["results"]["facts"]
    assert (found["name"], found["heldout_views"], found["train_frames"]) == ("rose", [], [0, 4])


def _opaque(toy: Any) -> None:
    path = toy.root / "sequences" / "seq_001" / "cam_1" / "0000.png"
    import cv2

    cv2.imwrite(str(path), np.zeros((32, 32, 3), np.uint8))


FAULTS = {
    "no alpha": (_opaque, DataError, r"seq_001/cam_1/0000\.png: expected 8-bit RGBA, got RGB.*segment"),
    "no sequences": (lambda toy: shutil.rmtree(toy.root / "sequences"), DataError, "has no sequences.*photos alone"),
    "no poses": (lambda toy: (toy.root / "sequences/seq_000/transforms.json").unlink(), DataError, "not found.*poses"),
    "rates": (
        lambda toy: edit_json(toy.root / "sequences/seq_001/transforms.json", lambda d: d.update(fps=25)),
        DataError, "different rates.*seq_000.*24",
    ),
    "no rate": (
        lambda toy: [edit_json(p, lambda d: d.pop("fps")) for p in toy.root.glob("sequences/*/transforms.json")],
        ConfigError, "--fps",
    ),
    "cameras": (
        lambda toy: edit_json(toy.root / "sequences/seq_001/transforms.json",
                          lambda d: d.update(frames=[f for f in d["frames"] if f["camera"] != "cam_2"])),
        DataError, r"seq_001.*has the cameras \['cam_0', 'cam_1'\], seq_000 has",
    ),
    "a picture is missing": (
        lambda toy: (toy.root / "sequences/seq_000/cam_0/0005.png").unlink(), DataError, r"cam_0/0005\.png: not found",
    ),
    "no pins": (
        lambda toy: save_scene(replace(toy.scene, pinned=torch.zeros(toy.scene.count, dtype=torch.bool)),
                               toy.root.parent / "scene" / "scene.ply"),
        DataError, r"scene\.ply: .*no kernel is pinned",
    ),
    "no scene": (lambda toy: (toy.root.parent / "scene/scene.ply").unlink(), DataError, "rest scene, as `reconstruct`"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named_and_nothing_is_left(toy: Any, tmp_path: Path, fault: str) -> None:
    spoil, kind, what = FAULTS[fault]
    spoil(toy)
    with pytest.raises(kind, match=what) as caught:
        assemble([toy.root], tmp_path / "out", scene=tmp_path / "scene")
    assert not (tmp_path / "out").exists() and ".work" not in str(caught.value)


@pytest.mark.parametrize(
    ("option", "what"),
    [({"heldout": ("cam_7",)}, "--heldout cam_7"), ({"heldout": ("cam_0", "cam_1", "cam_2")}, "--heldout"),
     ({"train_frames": 10}, "--train-frames 10: seq_000 has 9 frames"),
     ({"fps": float("nan")}, "--fps")],
)  # fmt: skip
def test_options_that_do_not_suit_are_named(toy: Any, tmp_path: Path, option: dict, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        assemble([toy.root], tmp_path / "out", AssembleOptions(**option))


class Capture:
    """A capture of the toy as a user has it: films of three cameras before a green screen, photos, a calibration."""

    def __init__(self, folder: Path) -> None:
        narrow = toy_object.cameras()
        wide = narrow.Ks * torch.tensor([2.0, 2.0, 1.0])[:, None]
        views = Cameras(narrow.viewmats, wide, 64, 64, narrow.names)
        self.toy = toy_object.ToyObject(folder, toy_object.toy_scene(), frames=12, cameras=views)
        self.folder = folder
        self.motion = {n: toy_object.rgba(self.toy.scene, self.toy.truth(n), views) for n in self.toy.amplitudes}
        self._write_photos()

    def _before_green(self, rgba: torch.Tensor) -> np.ndarray:
        alpha = rgba[..., 3:].numpy() / 255
        return (rgba[..., :3].numpy() * alpha + GREEN * (1 - alpha)).round().astype(np.uint8)

    def _write_photos(self) -> None:
        """Photos of the rest state and, under the cameras' names, what the fixed cameras saw, all calibrated."""
        photos, names = self.folder / "photos", []
        photos.mkdir(parents=True)
        rest = self.motion["seq_000"][0]
        for prefix in ("still", "cam"):
            for number, pixels in enumerate(rest):
                image = torch.cat([torch.from_numpy(self._before_green(pixels)), torch.full((64, 64, 1), 255)], -1)
                write_rgba(photos / f"{prefix}_{number}.png", image.to(torch.uint8))
                names.append(f"{prefix}_{number}.png")
        twice = self.toy.views.select([0, 1, 2, 0, 1, 2])
        write_transforms(photos / "calibration.json", twice, [{"file_path": name} for name in names])

    def write_films(self) -> None:
        for name, images in self.motion.items():
            for view in range(3):
                path = self.folder / "takes" / name / f"cam{view}.mp4"
                path.parent.mkdir(parents=True, exist_ok=True)
                with av.open(str(path), "w") as film:
                    video = film.add_stream("libx264", rate=RATE)
                    video.width = video.height = 64
                    video.pix_fmt, video.options = "yuv444p", {"crf": "12", "preset": "veryfast"}
                    # The second camera began two frames late.
                    for k, picture in enumerate(images[2 * (view == 1) :, view]):
                        frame = av.VideoFrame.from_ndarray(self._before_green(picture), format="rgb24")
                        frame.pts, frame.time_base = k, 1 / RATE
                        film.mux(video.encode(frame))
                    film.mux(video.encode())


def test_from_films_to_a_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All stages but the slow one, which the true kernels stand for."""
    capture = Capture(tmp_path / "capture")
    capture.write_films()
    bare = replace(capture.toy.scene, pinned=torch.zeros(capture.toy.scene.count, dtype=torch.bool))
    save_scene(bare, tmp_path / "rest" / "scene.ply")
    jobs: dict[Any, list] = {
        ingest: [capture.folder / "takes", "--sync", "offsets", "--offsets", "cam_0=0,cam_1=2f,cam_2=0"],
        poses: ["--transforms", capture.folder / "photos/calibration.json", "--sequences", tmp_path / "ingest"],
        segment: [tmp_path / "poses", *"--backend chroma --key 00b140 --no-grabcut --components 0".split()],
        select: [tmp_path / "rest" / "scene.ply", "--pinned", "below z=0.1", "--size", "64"],
        sys.modules["data_prep.assemble"]: [
            tmp_path / "segment", "--scene", tmp_path / "select", *"--name toy --train-frames 6".split()
        ],
        pack: [tmp_path / "assemble"],
    }  # fmt: skip
    for stage, argv in jobs.items():
        out = tmp_path / stage.__name__.rpartition(".")[2]
        assert stage.main([*map(str, argv), "--out", str(out)]) == 0, capsys.readouterr().err
    for root in (tmp_path / "assemble", tmp_path / "pack"):
        assert verify(root) == []
        data = ObjectData(root)
        assert data.name == "toy" and len(data.stills().images) == 3 and data.sequences[0].count == 10
        assert torch.equal(data.scene().pinned, capture.toy.scene.pinned)
        for record in data.sequences:
            found = record.frames(range(10), ("cam_0", "cam_1", "cam_2"))
            truth = capture.motion[record.name][2:12]
            inside, true = found[..., 3] > 127, truth[..., 3] > 127
            overlap = (inside & true).sum((0, 2, 3)) / (inside | true).sum((0, 2, 3))
            assert (overlap > 0.9).all(), overlap
            both = inside & true
            assert (found[..., :3].int() - truth[..., :3].int()).abs()[both].float().mean() < 12
            same = record.cameras_of(("cam_0", "cam_1", "cam_2"))
            assert torch.allclose(same.viewmats, capture.toy.views.viewmats, atol=1e-4)
    module = ReadyDataModule(root=str(tmp_path / "pack"), plan=TrainingPlan(t_start=1, t_max=5, batch_size=1))
    module.setup("fit")
    assert next(iter(module.train_dataloader())) is not None
