"""Small COLMAP models for tests, written byte by byte as the format's description says (loaded by path, like toys)."""

import math
import struct
from pathlib import Path

import pycolmap
from scipy.spatial.transform import Rotation

Camera = tuple[str, int, int, list[float]]
Image = tuple[str, int, tuple[float, ...], tuple[float, ...], list[tuple[float, float, int]]]
Point = tuple[int, tuple[float, float, float], tuple[int, int, int], float, list[tuple[int, int]]]


def turntable(azimuth: float, distance: float = 4.0) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Quaternion w x y z and translation of a level camera that looks at the origin, with world z up."""
    c, s = math.cos(azimuth), math.sin(azimuth)
    rows = [[-s, c, 0.0], [0.0, 0.0, -1.0], [-c, -s, 0.0]]
    return tuple(Rotation.from_matrix(rows).as_quat(scalar_first=True)), (0.0, 0.0, distance)


def write_binary(folder: Path, cameras: dict[int, Camera], images: dict[int, Image], points: list[Point]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    data = struct.pack("<Q", len(cameras))
    for number, (model, width, height, params) in cameras.items():
        data += struct.pack("<IiQQ", number, int(getattr(pycolmap.CameraModelId, model)), width, height)
        data += struct.pack(f"<{len(params)}d", *params)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for number, (name, camera, quaternion, translation, keypoints) in images.items():
        data += struct.pack("<I7dI", number, *quaternion, *translation, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", len(keypoints))
        data += b"".join(struct.pack("<2dQ", x, y, point % (1 << 64)) for x, y, point in keypoints)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for number, xyz, rgb, error, track in points:
        data += struct.pack("<Q3d3BdQ", number, *xyz, *rgb, error, len(track))
        data += b"".join(struct.pack("<II", *pair) for pair in track)
    (folder / "points3D.bin").write_bytes(data)


def write_text(folder: Path, cameras: dict[int, Camera], images: dict[int, Image], points: list[Point]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list"]
    lines += [f"{n} {m} {w} {h} " + " ".join(map(repr, p)) for n, (m, w, h, p) in cameras.items()]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list"]
    for n, (name, camera, quaternion, translation, keypoints) in images.items():
        pose = " ".join(repr(float(v)) for v in (*quaternion, *translation))
        lines += [f"{n} {pose} {camera} {name}", " ".join(f"{x!r} {y!r} {p}" for x, y, p in keypoints)]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Points"]
    for n, xyz, rgb, error, track in points:
        lines.append(" ".join(map(repr, (n, *xyz, *rgb, error))) + "".join(f" {i} {k}" for i, k in track))
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


def small_model(size: tuple[int, int] = (64, 48)) -> tuple[dict[int, Camera], dict[int, Image], list[Point]]:
    """Two cameras, three images on a turntable, three points."""
    width, height = size
    cameras: dict[int, Camera] = {
        1: ("PINHOLE", width, height, [60.0, 61.0, width / 2, height / 2]),
        7: ("SIMPLE_RADIAL", width, height, [60.0, width / 2, height / 2, 0.05]),
    }
    images: dict[int, Image] = {}
    for i, azimuth in enumerate((0.3, 1.4, 2.9)):
        quaternion, translation = turntable(azimuth)
        keypoints = [(10.5 + i, 20.25, 5), (1.0, 2.0, -1), (30.0, 31.0, 9)]
        images[i + 2] = (f"sub/photo_{i}.png" if i == 2 else f"photo_{i}.png", 7 if i else 1, quaternion, translation,
                         keypoints if i else [])  # fmt: skip
    points: list[Point] = [
        (5, (0.1, -0.2, 0.3), (250, 10, 7), 0.5, [(3, 0), (4, 0)]),
        (9, (1.0, 2.0, 3.0), (0, 255, 128), 0.25, [(3, 2), (4, 2)]),
        (12, (-1e-3, 4.0, 0.0), (1, 2, 3), -1.0, []),
    ]  # fmt: skip
    return cameras, images, points
