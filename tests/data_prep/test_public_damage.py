"""Damaged files of public sets are refused with file and field, and leave no result."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, reduce
from operator import getitem
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.plain import Call

from data_prep.import_3dgsim import GenesisOptions, import_3dgsim
from data_prep.import_pacnerf import PacNerfOptions, import_pacnerf
from data_prep.import_physdreamer import PhysDreamerOptions, import_physdreamer
from data_prep.import_phystwin import PhysTwinOptions, import_phystwin
from data_prep.import_springgaus import SpringGausOptions, import_springgaus
from gausim.core import GausSimError


@dataclass(frozen=True)
class Damage:
    """One fault, in one file of a sample."""

    file: str  # within the sample
    change: Callable[[Any], Any] | None  # of its content: what JSON, a pickle or a picture holds; None removes it
    told: str  # what the message has to name besides the file
    named: str | None = None  # the file in the message, where it is not this one


def put(*keys: Any, to: Any) -> Callable[[Any], Any]:
    """Replaces what stands in a place, or computes it from what stands there; None takes it out."""

    def change(data: Any) -> Any:
        place, last = reduce(getitem, keys[:-1], data), keys[-1]
        if to is None:
            del place[last]
        else:
            place[last] = to(place[last]) if callable(to) else to
        return data

    return change


drop = partial(put, to=None)


def narrow(pixels: np.ndarray) -> np.ndarray:
    return pixels[:, :-8]


def black(pixels: np.ndarray) -> np.ndarray:
    return 0 * pixels


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
    Damage("calibrate.pkl", put(0, to=Call(os.mkdir, "canary")), "posix.mkdir"),
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
    *(
        Damage("0001/metadata.json", put("file_path_template", to=text), "field 'file_path_template'")
        for text in (
            "cam_{cam_ix}/{n_step}",
            "{cam_ix.real}{n_step}{img_type}",
            "{cam_ix}{n_step}{img_type:04d}",
            "{cam_ix}{n_step:99999999d}{img_type}",
            "../{cam_ix}{n_step}{img_type}",
            "{cam_ix}{n_step}{img_type",
            "{cam_ix}{n_step!r}{img_type}",
        )
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


SETS: dict[str, tuple[tuple[Damage, ...], Callable[..., object], Any]] = {
    "springgaus": (SPRINGGAUS, import_springgaus, SpringGausOptions()),
    "real": (REAL_FILES, import_springgaus, SpringGausOptions(object="bun", no_stills=True)),
    "real, stills": (STILLS, import_springgaus, SpringGausOptions(object="bun", turns=1)),
    "pacnerf": (PACNERF, import_pacnerf, PacNerfOptions()),
    "phystwin": (PHYSTWIN, import_phystwin, PhysTwinOptions()),
    "genesis": (GENESIS, import_3dgsim, GenesisOptions(fps=25)),
    "physdreamer": (PHYSDREAMER, import_physdreamer, PhysDreamerOptions(anchor=0.4)),
}
CASES = [
    pytest.param(name, damage, id=f"{name}: {Path(damage.file).name}: {damage.told}")
    for name, (damages, *_) in SETS.items()
    for damage in damages
]


@pytest.mark.parametrize(("name", "damage"), CASES)
def test_damaged_files_are_refused(name: str, damage: Damage, sample_of: Callable[[str], Any], tmp_path: Path) -> None:
    _, run, options = SETS[name]
    root = sample_of(name.partition(",")[0]).root
    masks = {"video_masks": root.parent / "video_masks"} if name == "physdreamer" else {}
    path = (root / damage.file).resolve()
    good = path.read_bytes()
    try:
        harm(path, damage.change)
        assert not path.exists() or path.read_bytes() != good, "the damage changes nothing"
        with pytest.raises(GausSimError) as caught:
            run(root, tmp_path / "out", options, **masks)
    finally:
        path.write_bytes(good)
    text = str(caught.value)
    assert damage.told in text and (damage.named or path.name) in text, text
    assert not (tmp_path / "out").exists() and not Path("canary").exists()
