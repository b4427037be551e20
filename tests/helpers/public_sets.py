"""Small samples exactly in the layouts of public sets: painted balls whose motion and cameras are known."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from data_prep.common.photos import resized
from gausim.io.ply import save_scene
from gausim.io.video import write_video
from gausim.ops.orbit import look_at
from helpers import colmap_files, toy_object

FRAMES, SEEN, SIZE = 8, 5, 48
K = np.array([[60.0, 0, SIZE / 2], [0, 60.0, SIZE / 2], [0, 0, 1.0]])
_END = np.linspace(-1, 1, 9)
BALLS = np.stack((0.5 * _END, 0.15 * _END**2, 0.1 * _END), -1)
COLORS = np.stack((120 + 100 * _END, 160 + 0 * _END, 120 - 100 * _END), -1).astype(np.uint8)
RADIUS = 0.2


@dataclass
class Sample:
    """What was written, and the truth about it."""

    root: Path
    viewmats: np.ndarray  # (V, 4, 4) world to camera, OpenCV
    path: np.ndarray  # (F, N, 3) positions of the balls
    scale: float = 1.0

    @property
    def gl_poses(self) -> list:
        """Camera to world, OpenGL axes."""
        return (np.linalg.inv(self.viewmats) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()

    def image(self, frame: int, view: int) -> np.ndarray:
        """(H, W, 4) uint8 RGBA, painted from back to front with four samples per pixel."""
        fine, points, viewmat = 4, self.path[frame], self.viewmats[view]
        image = np.zeros((SIZE * fine, SIZE * fine, 4), np.uint8)
        local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        for i in np.argsort(-local[:, 2]):
            # OpenCV's pixel 0 has its centre at 0, ours at 0.5.
            x, y = (K[:2, :2] @ (local[i, :2] / local[i, 2]) + K[:2, 2]) * fine - 0.5
            radius = K[0, 0] * RADIUS * self.scale / local[i, 2] * fine
            color = (*map(int, COLORS[i]), 255)
            cv2.circle(image, (round(x * 16), round(y * 16)), round(radius * 16), color, -1, shift=4)
        return resized(image, (SIZE, SIZE))


def falling(root: Path, up: tuple[float, float, float], dt: float, scale: float) -> Sample:
    """A body that falls freely from its height times two, seen by three cameras."""
    above = np.array(up, float)
    t = dt * np.arange(FRAMES)
    path = scale * BALLS + np.multiply.outer(2 * scale - 4.9 * t**2, above)[:, None]
    side = np.roll(above, 1)
    eyes = [1.5 * scale * above + 3 * scale * (math.cos(a) * side + math.sin(a) * np.cross(above, side) + 0.3 * above)
            for a in (0.3, 2.4, 4.5)]  # fmt: skip
    look = [look_at(*map(torch.from_numpy, (eye, 1.7 * scale * above, above))).numpy() for eye in eyes]
    return Sample(root, np.stack(look), path, scale)


def write_springgaus(root: Path) -> Sample:
    """A synthetic object, `render/<obj>/`."""
    sample = falling(root, (0, 1, 0), 0.03, 0.4)
    poses = zip(range(3), sample.gl_poses, strict=True)
    dump(root / "camera.json", [{"camera": f"camera_{v}", "K": K.tolist(), "c2w": pose} for v, pose in poses])
    dump(root / "frame.json", [{f"{f:03d}": 0.03 * f} for f in range(FRAMES)])
    for v, f in np.ndindex(3, FRAMES):
        save(root / f"camera_{v}" / f"{f:03d}.png", sample.image(f, v))
    return sample


def write_gaussians(root: Path) -> toy_object.ToyObject:
    """A toy object with the point clouds of READY and PhysDreamer."""
    toy = toy_object.ToyObject(root, toy_object.toy_scene(), frames=FRAMES)
    root.mkdir(parents=True, exist_ok=True)
    save_scene(toy.scene, root / "point_cloud.ply")
    (root / "point_cloud.masks.npz").unlink()
    means = toy.scene.means.numpy()
    for name, points in (("moving_part_points", means[means[:, 2] > 0.5]), ("clean_object_points", means)):
        header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
        header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        (root / f"{name}.ply").write_text(header + "\n".join(" ".join(map(str, p + 0.004)) for p in points) + "\n")
    return toy


def write_physdreamer(root: Path) -> toy_object.ToyObject:
    """One object, `physics_dreamer/<obj>/`: COLMAP stills, a film from the second still's place, clouds."""
    toy = write_gaussians(root)
    write_model(root, toy, {f"frame_0000{i + 1}.png": i for i in range(3)})
    frames = toy.images("seq_000").numpy()
    for i in range(3):
        save(root / "images" / f"frame_0000{i + 1}.png", frames[0, i, ..., :3])
        save(root / "masks" / f"frame_0000{i + 1}_mask.png", frames[0, i, ..., 3])
    write_video(root / "videos" / "frame_00002_poke.mp4", frames[:, 1, ..., :3], 30, quality=1)
    for f in range(len(frames)):
        save(root.parent / "video_masks" / f"{f:04d}.png", frames[f, 1, ..., 3])
    return toy


def write_ready(root: Path) -> toy_object.ToyObject:
    """READY: sequence 2 shares the cameras of its twin 1, 3 has one camera more, 4 is invalid."""
    toy = write_gaussians(root)
    videos = {"seq_00001": (0, 1), "seq_00002": (0, 1), "seq_00003": (0, 1, 2), "seq_00004": (0, 1)}
    names = {"still_a.png": 0, "still_b.png": 1}
    names |= {f"{s}_cam_{c:05d}.png": c for s, views in videos.items() if s != "seq_00002" for c in views}
    write_model(root, toy, names)
    frames = toy.images("seq_000").numpy()
    for name, view in names.items():
        save(root / "images" / name, frames[0, view, ..., :3])
        save(root / "masks" / name, frames[0, view, ..., 3])
    for (sequence, views), f in ((item, f) for item in videos.items() for f in range(3)):
        for view in views:
            place = f"{sequence}_cam_{view:05d}/{f}.png"
            save(root / "video_images" / place, frames[f, view, ..., :3])
            save(root / "video_masks" / place, frames[f, view, ..., 3])
    dump(root / "meta.json", {"train": [1, "seq_00002"], "test": ["00003"], "invalid": [], "force_invalid": [4],
                              "twins": [[1, 2]]})  # fmt: skip
    dump(root / "pin_mask.json", {"indices": np.flatnonzero(toy.scene.means[:, 2].numpy() < 0.8).tolist()})
    return toy


def write_model(root: Path, toy: toy_object.ToyObject, names: dict[str, int]) -> None:
    """A COLMAP model of twice the pictures' size; ``names`` gives the view of each image."""
    views = toy.views
    k, size = 2 * views.Ks[0].double().numpy(), (2 * views.width, 2 * views.height)
    images = {}
    for i, (name, view) in enumerate(names.items(), 1):
        viewmat = views.viewmats[view].double().numpy()
        turn = Rotation.from_matrix(viewmat[:3, :3]).as_quat(scalar_first=True)
        images[i] = (name, 1, tuple(turn), tuple(viewmat[:3, 3]), [])
    cameras = {1: ("PINHOLE", *size, [k[0, 0], k[1, 1], k[0, 2], k[1, 2]])}
    colmap_files.write_binary(root / "sparse" / "0", cameras, images, colmap_files.small_model()[2])


def save(path: Path, pixels: np.ndarray) -> None:
    """Writes grey, RGB or RGBA."""
    path.parent.mkdir(parents=True, exist_ok=True)
    code = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}.get(pixels.shape[2] if pixels.ndim == 3 else 1)
    assert cv2.imwrite(str(path), pixels if code is None else cv2.cvtColor(pixels, code))


def before(rgba: np.ndarray, background: float | np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of a picture before a background."""
    alpha = rgba[..., 3:] / 255.0
    return np.asarray(np.round(rgba[..., :3] * alpha + background * (1 - alpha)), np.uint8)


def dump(path: Path, data: Any) -> None:
    """Writes JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data))


WRITERS = {
    "springgaus": (write_springgaus, "render/torus"),
    "physdreamer": (write_physdreamer, "physics_dreamer/hat"), "ready": (write_ready, "ready/duck"),
}  # fmt: skip
