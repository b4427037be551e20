"""Mistakes that strangers make with a data set, each applied to a copy of a good one."""

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from gausim.io.ply import masks_path
from helpers.plain import edit_json

Json = dict
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def every_transforms(root: Path, change: Callable[[Json], None]) -> None:
    for path in sorted(root.glob("sequences/*/transforms.json")):
        edit_json(path, change)


def every_pose(root: Path, change: Callable[[np.ndarray, str], np.ndarray]) -> None:
    def apply(data: Json) -> None:
        for entry in data["frames"]:
            entry["transform_matrix"] = change(np.array(entry["transform_matrix"]), entry["camera"]).tolist()

    every_transforms(root, apply)


def every_image(root: Path, change: Callable[[np.ndarray], np.ndarray], pattern: str = "*/*/*") -> None:
    for path in root.glob(f"sequences/{pattern}.png"):
        assert cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def views_of(root: Path) -> list[str]:
    return json.loads((root / "dataset.json").read_text())["views"]


def turn(degrees: float, axis: Sequence[float]) -> np.ndarray:
    """Turn about an axis through the camera's own centre, in its own axes."""
    pose = np.eye(4)
    pose[:3, :3], _ = cv2.Rodrigues(np.radians(degrees) * np.array(axis, float) / np.linalg.norm(axis))
    return pose


def lens(root: Path, *, written: bool) -> None:
    """The field of view is written in degrees where radian belongs, or the focal length was computed so."""

    def change(data: Json) -> None:
        angle = math.degrees(2 * math.atan(data["w"] / (2 * data["fl_x"])))
        if written:
            del data["fl_x"], data["fl_y"]
            data["camera_angle_x"] = angle
        else:
            data.pop("camera_angle_x", None)
            data["fl_x"] = data["fl_y"] = abs(data["w"] / (2 * math.tan(angle / 2)))

    every_transforms(root, change)


def every_alpha(root: Path, change: Callable[[np.ndarray], np.ndarray | int]) -> None:
    every_image(root, lambda p: np.dstack((p[..., :3], np.broadcast_to(np.uint8(change(p[..., 3])), p.shape[:2]))))


def wrong_rate(root: Path, factor: float) -> None:
    for path in (root / "dataset.json", *root.glob("sequences/*/transforms.json")):
        edit_json(path, lambda data: data.update(fps=data["fps"] * factor))


def missing_images(root: Path, *, listed: bool = True) -> None:
    """Frames 5 to 7 of one camera are gone from the folder, or from the list too."""
    sequence, view = sorted((root / "sequences").iterdir())[-1], views_of(root)[1]
    for path in sorted((sequence / view).iterdir())[5:8]:
        path.unlink()

    def change(data: Json) -> None:
        data["frames"] = [e for e in data["frames"] if e["camera"] != view or e["frame"] not in (5, 6, 7)]

    if not listed:
        edit_json(sequence / "transforms.json", change)


def moved_camera(root: Path, view: int = 1, degrees: float = 2.0) -> None:
    name, by = views_of(root)[view], turn(degrees, (0.3, 1.0, 0.2))
    every_pose(root, lambda pose, camera: pose @ by if camera == name else pose)


def moved_cameras(root: Path) -> None:
    """All cameras are off by 2 degrees, each about another axis."""
    axes = np.random.default_rng(3).normal(size=(len(views_of(root)), 3))
    by = {name: turn(2.0, axis) for name, axis in zip(views_of(root), axes, strict=True)}
    every_pose(root, lambda pose, camera: pose @ by[camera])


def reorder(folder: Path, place: Callable[[int], int]) -> None:
    """Every frame of a camera becomes the frame at another place, or the nearest that there is."""
    paths = sorted(folder.iterdir())
    content = [path.read_bytes() for path in paths]
    for number, path in enumerate(paths):
        path.write_bytes(content[min(max(place(number), 0), len(paths) - 1)])


def out_of_step(root: Path, view: int = 1, frames: int = 2) -> None:
    """A camera is late (its first frame comes again so many times) or, with a negative number, early."""
    for sequence in (root / "sequences").iterdir():
        reorder(sequence / views_of(root)[view], lambda number: number - frames)


def nothing_moves(root: Path) -> None:
    for folder in root.glob("sequences/*/*/"):
        reorder(folder, lambda number: 0)


def not_at_rest(root: Path) -> None:
    """One sequence begins in the middle of the motion."""
    for folder in sorted((root / "sequences").iterdir())[-1].glob("*/"):
        reorder(folder, lambda number: number + 6)


def darker(root: Path, factor: float, every: int = 1) -> None:
    """Every so many frames of one camera are darker."""
    for path in root.glob(f"sequences/*/{views_of(root)[1]}/*.png"):
        if int(path.stem) % every == every - 1:
            pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) * [factor, factor, factor, 1]
            assert cv2.imwrite(str(path), pixels.astype(np.uint8))


def one_view(root: Path) -> None:
    edit_json(root / "dataset.json", lambda d: d.update(train_views=d["views"][:1], heldout_views=d["views"][1:]))


MISTAKES: dict[str, Callable[[Path], None]] = {
    "field of view in degrees": lambda root: lens(root, written=True),
    "focal length from degrees": lambda root: lens(root, written=False),
    "OpenCV poses": lambda root: every_pose(root, lambda pose, _: pose @ _FLIP),
    "inverted poses": lambda root: every_pose(root, lambda pose, _: np.linalg.inv(pose @ _FLIP)),
    "millimetres": lambda root: every_pose(root, lambda pose, _: np.vstack((pose[:3] * [1, 1, 1, 1000], pose[3:]))),
    "inverted masks": lambda root: every_alpha(root, lambda alpha: 255 - alpha),
    "nothing cut out": lambda root: every_alpha(root, lambda alpha: 255),
    "rate over 4": lambda root: wrong_rate(root, 0.25),
    "rate in one file": lambda root: edit_json(root / "dataset.json", lambda data: data.update(fps=data["fps"] * 4)),
    "missing images": missing_images, "missing frames": lambda root: missing_images(root, listed=False),
    "one camera moved": moved_camera, "all cameras moved": moved_cameras, "one camera 2 frames late": out_of_step,
    "one camera 2 frames early": lambda root: out_of_step(root, frames=-2), "nothing moves": nothing_moves,
    "16-bit PNG": lambda root: every_image(root, lambda pixels: pixels.astype(np.uint16) * 257),
    "no alpha": lambda root: every_image(root, lambda pixels: pixels[..., :3]),
    "no pin": lambda root: masks_path(root / "scene.ply").unlink(), "not at rest": not_at_rest, "one view": one_view,
    "a dark camera": lambda root: darker(root, 0.6), "a flickering camera": lambda root: darker(root, 0.9, every=2),
}  # fmt: skip
