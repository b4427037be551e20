"""`gausim doctor`: nothing to say of a good object, and the right word about every mistake that a stranger makes."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers import mistakes, toy_object
from helpers.plain import edit_json
from helpers.swaying import SWINGS, Swaying, body, ring

from gausim.cli.main import main
from gausim.io.ply import load_scene, save_scene

FRAMES = 32


@pytest.fixture(scope="session")
def swaying(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One object that is in order, not to be changed."""
    root = tmp_path_factory.mktemp("doctor") / "swaying"
    toy = Swaying(root, body(), FRAMES, 16, amplitudes=dict.fromkeys(SWINGS, 1.0), cameras=ring())
    toy_object.write_object(toy)
    return root


@pytest.fixture
def spoilt(swaying: Path, tmp_path: Path) -> Path:
    """A copy of it, to be spoilt."""
    return Path(shutil.copytree(swaying, tmp_path / "swaying"))


MISTAKES = mistakes.MISTAKES


def told(root: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, dict]:
    status = main(["doctor", str(root), "--json", *more])
    return status, json.loads(capsys.readouterr().out)[str(root)]


def found(entry: dict) -> dict[str, dict]:
    """Findings but notes by check; the first of each."""
    return {f["check"]: f for f in reversed(entry["findings"]) if f["severity"] != "note"}


def test_a_good_object_has_no_fault_and_no_warning_and_two_pictures(swaying, tmp_path, capsys) -> None:
    out = tmp_path / "seen"
    status, entry = told(swaying, capsys, "--out", str(out))
    assert status == 0 and not entry["ruinous"] and not entry["faults"] and not entry["left_out"]
    assert found(entry) == {}
    assert all(cv2.imread(str(out / name)).std() > 5 for name in ("views.png", "motion.png"))
    orange = cv2.imread(str(out / "views.png"))[..., ::-1].astype(int)
    outline = (orange[..., 0] > 200) & (abs(orange[..., 1] - 150) < 30) & (orange[..., 2] < 90)
    assert outline.sum() > 200


# Mistake: check that must name it, its severity, what its sentence and its remedy must hold.
SAID = {
    "focal length from degrees": ("calibration", "fault", "focal length", "degrees"),
    "OpenCV poses": ("calibration", "fault", "OpenCV axes", "negate the second and third column"),
    "inverted poses": ("calibration", "fault", "world-to-camera", "invert every transform_matrix"),
    "millimetres": ("calibration", "fault", "another unit", "by 0.001"),
    "inverted masks": ("masks", "fault", "are inverted", "255 - alpha"),
    "nothing cut out": ("masks", "fault", "Nothing is cut out", "gausim prepare segment"),
    "rate over 4": ("motion", "warning", "6 frames per second is no usual rate", "'fps'"),
    "one camera moved": ("calibration", "fault", "cam_1 is not where the pose says", "pose of cam_1"),
    "all cameras moved": ("calibration", "fault", "4 of 4 cameras disagree", "Calibrate all cameras"),
    "one camera 2 frames late": (
        "clock",
        "fault",
        "cam_1 is not synchronised: it shows the motion 2 frames later",
        "cam_1",
    ),
    "one camera 2 frames early": ("clock", "fault", "it shows the motion 2 frames earlier", "all cameras but cam_1"),
    "nothing moves": ("motion", "fault", "Nothing moves", "Record sequences"),
    "16-bit PNG": ("files", "fault", "got 64x64 RGBA (16 bit)", "gausim verify"),
    "no alpha": ("files", "fault", "Re-export the frame with alpha", "gausim verify"),
    "no pin": ("pins", "fault", "no kernel is pinned", "--pin"),
    "not at rest": ("motion", "warning", "Frame 0 is not at rest in seq_003", "last frame before"),
    "one view": ("views", "fault", "one training view only (cam_0)", "two cameras"),
    "a dark camera": ("appearance", "warning", "cam_1 -", "exposure"),
    "a flickering camera": ("appearance", "warning", "The brightness of cam_1 jumps", "fixed exposure"),
}


def floater(root: Path) -> None:
    scene = load_scene(root / "scene.ply")
    scene.means[30] = 1e4
    save_scene(scene, root / "scene.ply")


def half_masked(pixels: np.ndarray) -> np.ndarray:
    pixels[len(pixels) // 2 :, :, 3] = 0
    return pixels


def cut_off(root: Path) -> None:
    """Pictures of one camera are cropped on the left, as its lens says, through the object."""

    def crop(data: dict) -> None:
        for entry in data["frames"]:
            if entry["camera"] == "cam_1":
                entry.update({"fl_x": data["fl_x"], "fl_y": data["fl_y"], "cx": data["cx"] - 20, "cy": data["cy"]})

    mistakes.every_transforms(root, crop)
    mistakes.every_image(root, lambda p: np.concatenate((p[:, 20:], np.zeros_like(p[:, :20])), 1), "*/cam_1/*")


def tiny(root: Path) -> None:
    def shrink(pixels: np.ndarray) -> np.ndarray:
        return np.pad(cv2.resize(pixels, (16, 16), interpolation=cv2.INTER_AREA), ((24, 24), (24, 24), (0, 0)))

    mistakes.every_transforms(root, lambda data: data.update(fl_x=data["fl_x"] / 4, fl_y=data["fl_y"] / 4))
    mistakes.every_transforms(root, lambda data: data.pop("camera_angle_x", None))
    mistakes.every_image(root, shrink)


def few_frames(root: Path) -> None:
    """Every third frame is kept, forth and back, so that a swing takes less than two frames."""
    there = [*range(0, 32, 3), *range(30, 0, -3)]
    for folder in root.glob("sequences/*/*/"):
        mistakes.reorder(folder, lambda number: there[number % len(there)])


def short(root: Path) -> None:
    edit_json(root / "dataset.json", lambda data: data.update(train_frames=[0, 4]))
    for name in ("seq_001", "seq_002", "seq_003"):
        shutil.rmtree(root / "sequences" / name)


def changed(change: Callable[[np.ndarray], np.ndarray], where: str = "*/*/*") -> Callable[[Path], None]:
    return lambda root: mistakes.every_image(root, change, where)


def masked(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    return lambda root: mistakes.every_alpha(root, change)


# Mistakes that need no sentence about all findings: check, severity and what one of its sentences or remedies holds.
MORE = {
    "empty masks": (changed(np.zeros_like, "*/cam_2/*"), "masks", "fault", "cam_2 never shows the object"),
    "haze": (changed(lambda p: np.concatenate((p[..., :3], np.maximum(p[..., 3:], 5)), -1), "*/cam_0/*"), "masks",
             "warning", "haze of faint alpha (1 to 26 of 255) lies around the object in cam_0"),
    "labels for alpha": (masked(lambda alpha: alpha > 127), "masks", "fault", "cam_3 never exceed 1 of 255"),
    "palette for alpha": (masked(lambda alpha: 76 * (alpha > 127)), "masks", "fault", "cam_3 never exceed 76 of 255"),
    "premultiplied": (changed(lambda p: np.dstack((p[..., :3] * (p[..., 3:] / 255) + 0.5, p[..., 3])).astype(np.uint8)),
                      "masks", "warning", "multiplied by alpha already"),
    "floater": (floater, "kernels", "warning", "1 of 48 kernels are outside of the body"),
    "a mask drops out": (changed(half_masked, "seq_000/cam_3/0010"), "masks", "warning",
                         "The mask of cam_3 jumps in size by more than 15% for a frame or two: seq_000 frame 10"),
    "cut off": (cut_off, "views", "warning", "The object is cut off at the left of cam_1"),
    "tiny": (tiny, "views", "warning", "The object is tiny in cam_"),
    "few frames": (few_frames, "motion", "warning", "too fast for steps of a frame"),
    "late in one sequence": (lambda root: mistakes.reorder(root / "sequences/seq_002/cam_3", lambda number: number - 3),
                             "clock", "fault", "3 frames later than the other cameras, in seq_002"),
    "late without scene": (lambda root: [(root / "scene.ply").unlink(), mistakes.out_of_step(root, view=0, frames=2)],
                           "clock", "fault", "cam_0 is not synchronised"),
    "short": (short, "extent", "warning", "Training sees 4 frames"),
}  # fmt: skip

# The others take a second each.
QUICK = ("OpenCV poses", "inverted masks", "one camera 2 frames late", "16-bit PNG", "short", "labels for alpha")


def quick_or_slow(mistakes: object) -> list:
    return [m if m in QUICK else pytest.param(m, marks=pytest.mark.slow) for m in mistakes]


@pytest.mark.parametrize("mistake", quick_or_slow(SAID))
def test_a_mistake_is_named_with_its_remedy(mistake: str, spoilt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check, severity, what, remedy = SAID[mistake]
    MISTAKES[mistake](spoilt)
    status, entry = told(spoilt, capsys)
    findings = found(entry)
    assert list(findings) == [check], findings
    assert findings[check]["severity"] == severity and status == (severity == "fault")
    assert what in findings[check]["what"] and remedy in findings[check]["remedy"], findings[check]


@pytest.mark.parametrize("mistake", quick_or_slow(MORE))
def test_other_mistakes_are_named(mistake: str, spoilt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spoil, check, severity, what = MORE[mistake]
    spoil(spoilt)
    status, entry = told(spoilt, capsys)
    assert any(f["check"] == check and what in f["what"] for f in entry["findings"] if f["severity"] == severity), entry
    assert status == any(f["severity"] == "fault" for f in entry["findings"])


# What verify finds before anything is looked at, word by word.
BROKEN = {
    "field of view in degrees": "In degrees that would be 0.",
    "rate in one file": "field 'fps' is 24, dataset.json says 96",
    "missing images": "3 of its images are missing",
    "missing frames": "view 'cam_1' lacks 3 of 32 frames (first: 5)",
}


@pytest.mark.parametrize("mistake", BROKEN)
def test_broken_files_are_named_before_all_else(mistake: str, spoilt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    MISTAKES[mistake](spoilt)
    status, entry = told(spoilt, capsys)
    assert status == 1 and entry["findings"] == []
    assert all(BROKEN[mistake] in what for _, what in entry["faults"]), entry["faults"]


def test_no_mistake_goes_untested() -> None:
    assert set(MISTAKES) == set(SAID) | set(BROKEN)


def test_a_folder_within_an_object_is_sent_to_the_object(swaying: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", str(swaying / "sequences")]) == 2
    assert f"part of the one in {swaying}" in capsys.readouterr().err


@pytest.mark.slow
def test_a_free_body_needs_no_pin_and_may_begin_elsewhere(spoilt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    MISTAKES["no pin"](spoilt)
    MISTAKES["not at rest"](spoilt)
    edit_json(spoilt / "dataset.json", lambda data: data.update(free=True))
    _, entry = told(spoilt, capsys)
    assert "pins" not in found(entry)
    assert not any("not at rest" in f["what"] for f in entry["findings"])


def test_a_free_body_is_compared_where_the_cameras_see_it(spoilt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = load_scene(spoilt / "scene.ply")
    scene.means.add_(torch.tensor([0.6, -0.4, 2.0]))
    save_scene(scene, spoilt / "scene.ply")
    edit_json(spoilt / "dataset.json", lambda data: data.update(free=True))
    status, entry = told(spoilt, capsys)
    assert status == 0 and found(entry) == {} and not any(f["check"] == "calibration" for f in entry["findings"])
    mistakes.moved_camera(spoilt)
    assert "cam_1 is not where the pose says" in found(told(spoilt, capsys)[1])["calibration"]["what"]
    scene.means.copy_(scene.means @ torch.tensor([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]]))
    save_scene(scene, spoilt / "scene.ply")
    status, entry = told(spoilt, capsys)
    assert status == 0 and any("begins turned or bent" in f["what"] for f in entry["findings"])


@pytest.mark.slow
def test_pins_may_be_given(spoilt: Path, capsys: pytest.CaptureFixture[str]) -> None:
    MISTAKES["no pin"](spoilt)
    assert told(spoilt, capsys, "--pin", "below z=0.1")[0] == 0
    status, entry = told(spoilt, capsys, "--pin", "below z=9")
    assert status == 1 and "pins" in found(entry)
