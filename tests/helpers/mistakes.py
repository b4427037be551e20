"""Mistakes that strangers make with a data set, each applied to a copy of a good one."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from gausim.io.ply import masks_path

Json = dict
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def copy_object(source: Path, root: Path, *, scene: Path | None = None, sequences: int = 3) -> Path:
    """Copies some sequences of an object, its facts and its rest scene, without stills and true motion."""
    root.mkdir(parents=True)
    shutil.copy(source / "dataset.json", root)
    for folder in sorted((source / "sequences").iterdir())[:sequences]:
        shutil.copytree(folder, root / "sequences" / folder.name, ignore=shutil.ignore_patterns("*.npz"))
    ply = scene or source / "scene.ply"
    shutil.copy(ply, root / "scene.ply")
    if masks_path(ply).is_file():
        shutil.copy(masks_path(ply), masks_path(root / "scene.ply"))
    return root


def edit(path: Path, change: Callable[[Json], None]) -> None:
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def every_transforms(root: Path, change: Callable[[Json], None]) -> None:
    for path in sorted(root.glob("sequences/*/transforms.json")):
        edit(path, change)


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


def angle_in_degrees(root: Path) -> None:
    """The field of view is written in degrees where radian belongs, and no focal length."""

    def change(data: Json) -> None:
        angle = 2 * math.atan(data["w"] / (2 * data["fl_x"]))
        for key in ("fl_x", "fl_y"):
            data.pop(key)
        data["camera_angle_x"] = math.degrees(angle)

    every_transforms(root, change)


def lens_from_degrees(root: Path) -> None:
    """The focal length was computed with the tangent of degrees."""

    def change(data: Json) -> None:
        angle = math.degrees(2 * math.atan(data["w"] / (2 * data["fl_x"])))
        data["fl_x"] = data["fl_y"] = abs(data["w"] / (2 * math.tan(angle / 2)))

    every_transforms(root, change)


def opencv_poses(root: Path) -> None:
    every_pose(root, lambda pose, _: pose @ _FLIP)


def inverted_poses(root: Path) -> None:
    every_pose(root, lambda pose, _: np.linalg.inv(pose @ _FLIP))


def millimetres(root: Path) -> None:
    def change(pose: np.ndarray, _: str) -> np.ndarray:
        pose[:3, 3] *= 1000
        return pose

    every_pose(root, change)


def inverted_masks(root: Path) -> None:
    def change(pixels: np.ndarray) -> np.ndarray:
        pixels[..., 3] = 255 - pixels[..., 3]
        return pixels

    every_image(root, change)


def no_masks(root: Path) -> None:
    def change(pixels: np.ndarray) -> np.ndarray:
        pixels[..., 3] = 255
        return pixels

    every_image(root, change)


def wrong_rate(root: Path, factor: float) -> None:
    def change(data: Json) -> None:
        data["fps"] = data["fps"] * factor

    edit(root / "dataset.json", change)
    every_transforms(root, change)


def wrong_rate_in_one_file(root: Path) -> None:
    edit(root / "dataset.json", lambda data: data.update(fps=data["fps"] * 4))


def missing_images(root: Path) -> None:
    folder = sorted((root / "sequences").iterdir())[-1] / views_of(root)[1]
    for path in sorted(folder.iterdir())[5:8]:
        path.unlink()


def missing_frames(root: Path) -> None:
    """Frames 5 to 7 of one camera are gone, from the folder and from the list."""
    missing_images(root)
    view, path = views_of(root)[1], sorted(root.glob("sequences/*/transforms.json"))[-1]

    def change(data: Json) -> None:
        data["frames"] = [e for e in data["frames"] if e["camera"] != view or e["frame"] not in (5, 6, 7)]

    edit(path, change)


def moved_camera(root: Path, view: int = 1, degrees: float = 2.0) -> None:
    name, by = views_of(root)[view], turn(degrees, (0.3, 1.0, 0.2))
    every_pose(root, lambda pose, camera: pose @ by if camera == name else pose)


def moved_cameras(root: Path) -> None:
    """All cameras are off by 2 degrees, each about another axis."""
    axes = np.random.default_rng(3).normal(size=(len(views_of(root)), 3))
    by = {name: turn(2.0, axis) for name, axis in zip(views_of(root), axes, strict=True)}
    every_pose(root, lambda pose, camera: pose @ by[camera])


def out_of_step(root: Path, view: int = 1, frames: int = 2) -> None:
    """A camera is late (its first frame comes again so many times) or, with a negative number, early."""
    for folder in (path / views_of(root)[view] for path in (root / "sequences").iterdir()):
        paths = sorted(folder.iterdir())
        content = [path.read_bytes() for path in paths]
        for number, path in enumerate(paths):
            path.write_bytes(content[min(max(number - frames, 0), len(paths) - 1)])


def nothing_moves(root: Path) -> None:
    for folder in root.glob("sequences/*/*/"):
        paths = sorted(folder.iterdir())
        for path in paths[1:]:
            shutil.copy(paths[0], path)


def sixteen_bit(root: Path) -> None:
    every_image(root, lambda pixels: pixels.astype(np.uint16) * 257)


def without_alpha(root: Path) -> None:
    every_image(root, lambda pixels: pixels[..., :3])


def film_for_frames(root: Path) -> None:
    """The folder holds the camera's HEVC film under the name of the first frame."""
    import av

    path = sorted(root.glob("sequences/*/*/*.png"))[0]
    height, width = cv2.imread(str(path)).shape[:2]
    film = path.with_suffix(".mp4")
    with av.open(str(film), "w") as container:
        stream = container.add_stream("libx265" if "libx265" in av.codecs_available else "libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for _ in range(4):
            frame = av.VideoFrame.from_ndarray(np.zeros((height, width, 3), np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())

    def change(data: Json) -> None:
        for entry in data["frames"]:
            if entry["file_path"] == f"{path.parent.name}/{path.name}":
                entry["file_path"] = f"{path.parent.name}/{film.name}"

    edit(path.parent.parent / "transforms.json", change)


def films_for_folders(root: Path) -> None:
    """The cameras' films lie in a sequence's folder instead of their frames."""
    folder = sorted((root / "sequences").iterdir())[0]
    film_for_frames(root)
    film = next(folder.glob("*/*.mp4")).rename(folder / f"{views_of(root)[0]}.MP4")
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path != film:
            path.unlink()


def no_pin(root: Path) -> None:
    masks_path(root / "scene.ply").unlink()


def not_at_rest(root: Path, first: int = 6) -> None:
    """One sequence begins in the middle of the motion."""
    for folder in sorted((root / "sequences").iterdir())[-1].glob("*/"):
        paths = sorted(folder.iterdir())
        content = [path.read_bytes() for path in paths]
        for number, path in enumerate(paths):
            path.write_bytes(content[min(number + first, len(paths) - 1)])


def one_view(root: Path) -> None:
    def change(data: Json) -> None:
        data.update(train_views=data["views"][:1], heldout_views=data["views"][1:])

    edit(root / "dataset.json", change)


def dark_camera(root: Path) -> None:
    every_image(root, lambda pixels: (pixels * [0.6, 0.6, 0.6, 1]).astype(np.uint8), f"*/{views_of(root)[1]}/*")


def flickering_camera(root: Path) -> None:
    """Every other frame of one camera is darker by a tenth."""
    for path in root.glob(f"sequences/*/{views_of(root)[1]}/*.png"):
        if int(path.stem) % 2:
            pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) * [0.9, 0.9, 0.9, 1]
            assert cv2.imwrite(str(path), pixels.astype(np.uint8))


MISTAKES: dict[str, Callable[[Path], None]] = {
    "field of view in degrees": angle_in_degrees,
    "focal length from degrees": lens_from_degrees,
    "OpenCV poses": opencv_poses,
    "inverted poses": inverted_poses,
    "millimetres": millimetres,
    "inverted masks": inverted_masks,
    "nothing cut out": no_masks,
    "rate times 4": lambda root: wrong_rate(root, 4),
    "rate over 4": lambda root: wrong_rate(root, 0.25),
    "rate in one file": wrong_rate_in_one_file,
    "missing images": missing_images,
    "missing frames": missing_frames,
    "one camera moved": moved_camera,
    "all cameras moved": moved_cameras,
    "one camera 2 frames late": out_of_step,
    "one camera 2 frames early": lambda root: out_of_step(root, frames=-2),
    "nothing moves": nothing_moves,
    "16-bit PNG": sixteen_bit,
    "no alpha": without_alpha,
    "a film for frames": film_for_frames,
    "films for folders": films_for_folders,
    "no pin": no_pin,
    "not at rest": not_at_rest,
    "one view": one_view,
    "a dark camera": dark_camera,
    "a flickering camera": flickering_camera,
}
