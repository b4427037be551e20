"""Small samples exactly in the layouts of public sets: bodies of painted balls whose motion and cameras are known."""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from data_prep.public.pictures import resized
from gausim.io.ply import save_scene
from gausim.io.video import write_video
from gausim.ops.orbit import look_at
from helpers import colmap_files, toy_object

GL = np.diag([1.0, -1.0, -1.0, 1.0])
# 70 % of the frames, which PhysTwin's cases train on.
FRAMES, SEEN = 24, 16


@dataclass(frozen=True)
class Body:
    """Balls, of which pictures are painted from back to front."""

    points: np.ndarray  # (N, 3)
    radii: np.ndarray  # (N,)
    colors: np.ndarray  # (N, 3) uint8


@dataclass(frozen=True)
class Rig:
    """Cameras of one size."""

    viewmats: np.ndarray  # (V, 4, 4) world to camera, OpenCV
    k: np.ndarray  # (3, 3)
    size: tuple[int, int]

    @property
    def gl_poses(self) -> np.ndarray:
        """Camera to world, OpenGL axes."""
        return np.linalg.inv(self.viewmats) @ GL


@dataclass
class Sample:
    """What was written, and the truth about it."""

    root: Path
    rig: Rig
    path: np.ndarray  # (F, N, 3) true positions of the balls' centres in the set's world
    body: Body
    more: dict[str, Any] = field(default_factory=dict)

    def image(self, frame: int, view: int) -> np.ndarray:
        return paint(self.body, self.path[frame], self.rig.viewmats[view], self.rig.k, self.rig.size)


def dog(scale: float = 1.0) -> Body:
    """A body that no turn maps onto itself: trunk, neck, head, one raised leg; its colours say what is where."""
    parts = [
        (np.linspace((-0.5, 0, 0), (0.5, 0, 0), 9), 0.18, (200, 60, 40)),
        (np.linspace((0.5, 0, 0), (0.65, 0, 0.45), 5), 0.12, (60, 190, 60)),
        (np.linspace((0.65, 0, 0.45), (0.95, 0.1, 0.45), 4), 0.13, (60, 70, 210)),
        (np.linspace((-0.4, 0, 0), (-0.4, 0.1, -0.5), 5), 0.09, (210, 200, 50)),
        (np.linspace((0.4, 0, 0), (0.5, 0.5, -0.1), 5), 0.09, (190, 60, 190)),
    ]
    points = np.concatenate([p for p, _, _ in parts]) * scale
    radii = np.concatenate([np.full(len(p), r) for p, r, _ in parts]) * scale
    colors = np.concatenate([np.tile(c, (len(p), 1)) for p, _, c in parts]).astype(np.uint8)
    return Body(points - points.mean(0), radii, colors)


def look(eye: np.ndarray, at: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(4, 4) world to camera, OpenCV."""
    return look_at(*map(torch.from_numpy, (eye, at, up))).numpy()


def rig(
    at: tuple[float, float, float], up: tuple[float, float, float], *, views: int = 3, distance: float = 3.0,
    size: tuple[int, int] = (48, 48), focal: float = 55.0, level: float = 0.4, first: float = 0.3,
) -> Rig:  # fmt: skip
    """Cameras around a place, ``level`` [radian] above it."""
    middle, above = np.array(at), np.array(up, float)
    side = np.cross(above, (0.3, 0.5, 0.8) if abs(above[2]) < 0.5 else (1.0, 0, 0))
    side /= np.linalg.norm(side)
    other = np.cross(above, side)
    viewmats = []
    for i in range(views):
        a = first + i * 2 * math.pi / views
        lift = level * (1 if i % 2 else 0.5)
        eye = middle + distance * (math.cos(lift) * (math.cos(a) * side + math.sin(a) * other) + math.sin(lift) * above)
        viewmats.append(look(eye, middle, above))
    k = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    return Rig(np.stack(viewmats), k, size)


def paint(body: Body, points: np.ndarray, viewmat: np.ndarray, k: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W, 4) uint8 RGBA, from back to front, four samples per pixel."""
    fine = 4
    image = np.zeros((size[1] * fine, size[0] * fine, 4), np.uint8)
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    for i in np.argsort(-local[:, 2]):
        x, y, z = local[i]
        # OpenCV's pixel 0 has its centre at 0, ours at 0.5.
        place = (k[0, 0] * x / z + k[0, 2]) * fine - 0.5, (k[1, 1] * y / z + k[1, 2]) * fine - 0.5
        color = (*(int(c) for c in body.colors[i]), 255)
        centre = (round(place[0] * 16), round(place[1] * 16))
        cv2.circle(image, centre, round(k[0, 0] * body.radii[i] / z * fine * 16), color, -1, shift=4)
    return resized(image, size)


def fall(body: Body, start: tuple[float, float, float], up: np.ndarray, floor: float, dt: float) -> np.ndarray:
    """(F, N, 3) free fall, and a bounce with half the speed from a floor at this height."""
    gravity, height, speed = 9.8, float(np.dot(start, up)), 0.0
    lowest = float((body.points @ up - body.radii).min())
    heights = []
    for _ in range(FRAMES):
        heights.append(height)
        speed -= gravity * dt
        height += speed * dt
        if height + lowest < floor:
            height, speed = floor - lowest, -0.5 * speed
    away = np.array(heights) - heights[0]
    return body.points[None] + np.array(start) + away[:, None, None] * up


def write_springgaus(root: Path) -> Sample:
    """A synthetic object, `render/<obj>/`."""
    body, up = dog(0.2), np.array([0.0, 1.0, 0.0])
    cameras = rig((0.5, 0.55, 0.5), (0, 1, 0), distance=1.2, focal=64)
    sample = Sample(root, cameras, fall(body, (0.5, 0.75, 0.5), up, 0.3, 0.03), body)
    entries = [
        {"camera": f"camera_{v}", "K": cameras.k.tolist(), "c2w": cameras.gl_poses[v].tolist()} for v in range(3)
    ]
    for v in range(3):
        for f in range(FRAMES):
            save(root / f"camera_{v}" / f"{f:03d}.png", sample.image(f, v))
    dump(root / "camera.json", entries)
    dump(root / "frame.json", [{f"{f:03d}": 0.03 * f} for f in range(FRAMES)])
    return sample


def write_springgaus_real(root: Path, *, stills: int = 14) -> Sample:
    """Real captures of one object, `real_capture/`; the films' world is the stills' turned, scaled and moved."""
    body, name, down = dog(0.1), "bun", np.array([0.0, 0.0, 1.0])
    dynamic = rig((0, 0, -0.22), (0, 0, -1), distance=0.75, size=(96, 54), focal=105)
    path = fall(body, (0, 0, -0.3), -down, 0.02, 1 / 120)
    turn, scale, shift = Rotation.from_rotvec([0.5, -1.9, 0.8]).as_matrix(), 0.4, np.array([0.3, -0.2, 0.1])
    # The stills' world: x_films = scale · turn x + shift.
    rest = (path[0] - shift) / scale @ turn
    large = Body(rest, body.radii / scale, body.colors)
    around = rig(
        tuple(rest.mean(0)), (0.1, 0.2, 1), views=stills, distance=1.6, size=(108, 60), focal=110 * 108 / 96, level=0.7
    )
    static = root / "static"
    cameras = {1: ("PINHOLE", 216, 120, [*(2 * around.k[[0, 1], [0, 1]]), 108.0, 60.0])}
    images = {}
    for i, viewmat in enumerate(around.viewmats):
        images[i + 1] = (f"DSC{i:03d}.JPG", 1, *colmap_pose(viewmat), [])
        rgba = paint(large, rest, viewmat, around.k, around.size)
        save(static / "images" / name / f"DSC{i:03d}.JPG", cv2.resize(before(rgba, 90), (216, 120)))
        save(static / "masks" / name / f"DSC{i:03d}.png", rgba[..., 3])
    colmap_files.write_binary(static / "colmap" / name, cameras, images, [])
    (static / "colmap" / name / "points3D.bin").unlink()
    sample = Sample(root, dynamic, path, body, {"scale": scale, "turn": turn, "shift": shift, "stills": around})
    calibration, sequence = {}, {"hit_frame": 5}
    for v, camera in enumerate(("C0733", "C0787", "C0801")):
        viewmat = dynamic.viewmats[v]
        rotation = Rotation.from_matrix(viewmat[:3, :3]).as_rotvec()
        calibration[camera] = {"rvecs": rotation.tolist(), "tvecs": viewmat[:3, 3].tolist()}
        sequence[camera] = [f"{f + 100}.jpg" for f in range(FRAMES)]
        for f in range(FRAMES):
            rgba = sample.image(f, v)
            save(root / "dynamic" / "videos_images" / camera / f"{f + 100}.jpg", before(rgba, 70))
            save(root / "dynamic" / "videos_masks" / camera / f"{f + 100}.png", rgba[..., 3])
    dump(root / "dynamic" / "cameras_calib.json", calibration)
    dump(root / "dynamic" / "sync.json", {})
    dump(root / "dynamic" / "sequences" / name / "0.json", sequence)
    return sample


def write_pacnerf(root: Path, *, kind: str = "matted") -> Sample:
    """One object, `data/<obj>/`; ``kind``: ``plate`` (frame −1 only), ``matted`` (m_*) or ``rgba`` (a_*)."""
    body, up = dog(0.5), np.array([0.0, 1.0, 0.0])
    cameras = rig((0, 0.9, 0), (0, 1, 0), distance=4.0, focal=80, size=(64, 64))
    sample = Sample(root, cameras, fall(body, (0, 1.6, 0), up, 0.0, 1 / 24), body)
    folder, entries = root / "data", []
    y, x = np.mgrid[:64, :64]
    for v in range(3):
        plate = np.stack((60 + x, 90 + y // 2, 120 - x // 2 + 10 * v), -1).astype(np.uint8)
        save(folder / f"r_{v}_-1.png", plate)
        for f in range(FRAMES):
            rgba = sample.image(f, v)
            save(folder / f"r_{v}_{f}.png", before(rgba, plate))
            if kind == "matted":
                save(folder / f"m_{v}_{f}.png", before(rgba, 255))
            elif kind == "rgba":
                save(folder / f"a_{v}_{f}.png", rgba)
            entries.append({"file_path": f"./data/r_{v}_{f}.png", "time": f / 24,
                            "c2w": cameras.gl_poses[v][:3].tolist(), "intrinsic": cameras.k.tolist()})  # fmt: skip
    ignored = np.zeros((64, 64, 4), np.uint8)
    ignored[:4, :, 3] = 255
    save(folder / "r_1_-2.png", ignored)
    dump(root / "all_data.json", entries)
    return sample


def bar(count: int = 17) -> Body:
    t = np.linspace(-1, 1, count)
    points = np.stack((0.15 * t, 0 * t, 0 * t), -1)
    colors = np.stack((120 + 100 * t, 160 + 0 * t, 120 - 100 * t), -1).astype(np.uint8)
    return Body(points, np.full(count, 0.018), colors)


def write_phystwin(root: Path) -> Sample:
    """A case, `different_types/<case>/`: a bar between two hands, whose own pixels hide a part of it."""
    body, number = bar(), {0: "1", 1: "2", 2: "1"}
    cameras = rig((0, 0, -0.15), (0, 0, -1), distance=0.6, size=(64, 36), focal=60)
    t = np.arange(FRAMES) / FRAMES
    left = np.stack((-0.15 - 0.04 * t, 0 * t, -0.15 - 0.1 * np.sin(3 * t)), -1)
    right = np.stack((0.15 + 0.04 * t, 0.02 * t, -0.15 + 0 * t), -1)
    share = np.linspace(0, 1, len(body.points))[None, :, None]
    path = left[:, None] * (1 - share) + right[:, None] * share
    path[..., 2] += 0.03 * np.sin(math.pi * share[..., 0])  # z is down: the middle sags
    sample = Sample(root, cameras, path, body)
    offsets = 0.012 * np.random.default_rng(0).standard_normal((6, 3))
    # The points of the two hands alternate.
    points = np.stack((left[:, None] + offsets, right[:, None] + offsets), 2).reshape(FRAMES, 12, 3)
    human = root.parent.parent / "different_types_human_mask" / root.name / "mask"
    for v in range(3):
        names = {number[v]: "sloth", "0": "hand", ("2" if number[v] == "1" else "1"): "hand"}
        dump(root / "mask" / f"mask_info_{v}.json", names)
        for f in range(FRAMES):
            rgba = sample.image(f, v)
            save(root / "color" / str(v) / f"{f}.png", before(rgba, 70))
            save(root / "mask" / str(v) / number[v] / f"{f}.png", np.where(rgba[..., 3] > 127, 255, 0).astype(np.uint8))
            hidden = np.zeros((36, 64), np.uint8)
            hidden[:, :6] = 255
            save(human / str(v) / "0" / f"{f}.png", hidden)
    dump(root / "metadata.json", {"intrinsics": [cameras.k.tolist()] * 3, "serial_numbers": ["a", "b", "c"], "fps": 30,
                                  "WH": [64, 36], "recording": {"0": 1}, "frame_num": FRAMES})  # fmt: skip
    dump(root / "split.json", {"frame_len": FRAMES, "train": [0, SEEN], "test": [SEEN, FRAMES]})
    tracks = path[:, ::4].copy()
    tracks[5:7, 1] = np.nan
    final = {
        "object_points": path, "object_colors": np.repeat(body.colors[None] / 255.0, FRAMES, 0),
        "object_visibilities": np.ones(path.shape[:2], bool), "object_motions_valid": np.ones(path.shape[:2], bool),
        "controller_points": points, "surface_points": path[0], "interior_points": np.zeros((0, 3)),
    }  # fmt: skip
    poses = [np.linalg.inv(viewmat) for viewmat in cameras.viewmats]
    for name, data in (("calibrate.pkl", poses), ("final_data.pkl", final), ("gt_track_3d.pkl", tracks)):
        (root / name).write_bytes(pickle.dumps(data))
    sample.more = {"hands": points, "tracks": tracks}
    return sample


def write_3dgsim(root: Path, *, samples: tuple[str, ...] = ("0001", "0002"), moved: str | None = None) -> Sample:
    """Samples of one object, `<object>/<sample>/`; the cameras of the sample ``moved`` stand elsewhere."""
    body, up = dog(0.3), np.array([0.0, 0.0, 1.0])
    for number, name in enumerate(samples):
        cameras = rig((0, 0, 0.6), (0, 0, 1), distance=2.4, focal=64, first=0.9 if name == moved else 0.3)
        path = fall(body, (0.1 * number, 0, 1.0), up, 0.0, 0.04)
        sample = Sample(root / name, cameras, path, body)
        # Without a 0 anywhere the numbers begin with 1: background 1, object 3, static part 4.
        first = number % 2
        meta: dict[str, Any] = {
            "n_steps": FRAMES,
            "n_cams": 3,
            "file_path_template": "cam_{cam_ix}/{img_type}_{n_step:04d}",
        }
        for v in range(3):
            meta[f"cam_{v}"] = {"extrinsics": cameras.viewmats[v].tolist(), "intrinsics": cameras.k.tolist(),
                                "resolution": list(cameras.size)}  # fmt: skip
            for f in range(FRAMES):
                rgba = sample.image(f, v)
                save(root / name / f"cam_{v}" / f"rgb_{f:04d}.png", before(rgba, 100))
                numbers = np.where(rgba[..., 3] > 127, 2, 0).astype(np.uint8)
                numbers[-3:] = 3
                save(root / name / f"cam_{v}" / f"seg_{f:04d}.png", numbers + first)
        dump(root / name / "metadata.json", meta)
    return Sample(root, cameras, path, body)


def write_physdreamer(root: Path) -> toy_object.ToyObject:
    """One object, `physics_dreamer/<obj>/`: COLMAP stills, a film from the second still's place, clouds."""
    scene = toy_object.toy_scene()
    toy = toy_object.ToyObject(root, scene, frames=FRAMES)
    views = toy.views
    cameras = {1: ("PINHOLE", 32, 32, [56.0, 56.0, 16.0, 16.0])}
    images = {i + 1: (f"frame_0000{i + 1}.png", 1, *colmap_pose(viewmat), [])
              for i, viewmat in enumerate(views.viewmats.double().numpy())}  # fmt: skip
    colmap_files.write_binary(root / "sparse" / "0", cameras, images, colmap_files.small_model()[2])
    frames = toy.images("seq_000").numpy()
    for i in range(3):
        save(root / "images" / f"frame_0000{i + 1}.png", frames[0, i, ..., :3])
        save(root / "masks" / f"frame_0000{i + 1}_mask.png", frames[0, i, ..., 3])
    write_video(root / "videos" / "frame_00002_poke.mp4", frames[:, 1, ..., :3], 30, quality=1)
    for f in range(len(frames)):
        save(root.parent / "video_masks" / f"{f:04d}.png", frames[f, 1, ..., 3])
    save_scene(scene, root / "point_cloud.ply")
    (root / "point_cloud.masks.npz").unlink()
    means = scene.means.numpy()
    write_cloud(root / "moving_part_points.ply", means[means[:, 2] > 0.5] + 0.004)
    write_cloud(root / "clean_object_points.ply", means + 0.004)
    return toy


def save(path: Path, pixels: np.ndarray) -> None:
    """Writes grey, RGB or RGBA."""
    path.parent.mkdir(parents=True, exist_ok=True)
    code = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}.get(pixels.shape[2] if pixels.ndim == 3 else 1)
    assert cv2.imwrite(str(path), pixels if code is None else cv2.cvtColor(pixels, code))


def before(rgba: np.ndarray, background: float | np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of a picture before a background."""
    alpha = rgba[..., 3:] / 255.0
    return np.asarray(np.round(rgba[..., :3] * alpha + background * (1 - alpha)), np.uint8)


def write_cloud(path: Path, points: np.ndarray) -> None:
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_text(header + "\n".join(" ".join(map(repr, map(float, p))) for p in points) + "\n")


def colmap_pose(viewmat: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Quaternion w x y z and translation."""
    return tuple(Rotation.from_matrix(viewmat[:3, :3]).as_quat(scalar_first=True)), tuple(viewmat[:3, 3])


def dump(path: Path, data: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data))
