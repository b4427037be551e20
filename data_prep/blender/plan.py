"""What a set made by Blender consists of: its sizes, its pushes, its cameras, its cage; all before Blender starts.

Everything follows from the plan and the surface. A job for ``blender_scene`` is plain data: ``rest`` (file of the
surface), ``cage`` (lattice), ``camera``, ``samples``, ``motion`` (what moves; None for stills) and ``images``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.blender.surface import SIZE, UP_AXES, Surface, farthest_points
from gausim.core import ConfigError

FPS = 24
# Blender's frames per frame of the video, and how many of them a push lasts (15.6 ms).
SUBSTEPS, PUSH_TICKS = 8, 3
TRIAL_FRAMES = 18
TRAINED_FRAMES = 16
# Control points along the longest and along the shortest axis; the lowest layers are held.
MOST_POINTS, FEWEST_POINTS, PINNED_LAYERS = 7, 4, 2
CAGE_MARGIN = 1.04
FIELD_OF_VIEW = math.radians(40.0)
ROOM = 1.05  # times the distance from which the sphere around the object fills the image: it is going to move
FALLOFF = {"poke": 4.0, "drag": 2.0, "double": 4.0}
KINDS = ("poke", "drag", "double", "poke", "drag")
SITES = 8
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
TRAIN_ELEVATIONS, HELDOUT_ELEVATION, STILL_ELEVATION = (18.0, 22.0, 16.0, 24.0), 32.0, 80.0


@dataclass(frozen=True)
class Plan:
    """Sizes and settings of a set; the defaults are the paper's synthetic set.

    Attributes:
        name: of the object.
        up: the mesh's axis that points up.
        sequences: how many motions.
        frames: of each, at 24 per second.
        views: cameras of each sequence.
        heldout: how many of them are never trained on.
        stills: pictures of the rest state.
        resolution: width and height of the sequences [pixels].
        still_resolution: of the stills.
        samples: paths per pixel.
        points: vertices whose true motion is stored.
        amplitude: smallest and largest displacement that a push may cause [% of the diagonal].
        stiffness: of the soft body's springs, 0..1.
        bend: resistance to bending.
        damping: of the springs' vibrations.
        speed: of time in the soft body.
        steps: least steps per frame of Blender; more lose less energy.
        seed: of everything random.
    """

    name: str = "object"
    up: str = "y"
    sequences: int = 30
    frames: int = 60
    views: int = 5
    heldout: int = 1
    stills: int = 200
    resolution: tuple[int, int] = (540, 960)
    still_resolution: tuple[int, int] = (540, 960)
    samples: int = 16
    points: int = 2048
    amplitude: tuple[float, float] = (8.0, 13.0)
    stiffness: float = 0.7
    bend: float = 5.0
    damping: float = 0.02
    speed: float = 0.11
    steps: int = 30
    seed: int = 0

    def checked(self) -> Plan:
        """Itself.

        Raises:
            ConfigError: a field is out of its range; names the option.
        """
        if self.up not in UP_AXES:
            raise ConfigError(f"--up: expected one of {', '.join(UP_AXES)}, got '{self.up}'.")
        for name, low, high in _RANGES:
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if not low <= number <= high:
                    raise ConfigError(f"--{name.replace('_', '-')}: expected {low:g} to {high:g}, got {number:g}.")
        if self.heldout >= self.views:
            raise ConfigError(f"--heldout: expected fewer than the {self.views} --views, got {self.heldout}.")
        if self.amplitude[0] > self.amplitude[1]:
            raise ConfigError(f"--amplitude: expected the smaller one first, got {self.amplitude}.")
        return self

    def quick(self) -> Plan:
        """The same in small, for tests: 2 sequences of 8 frames."""
        small = {"sequences": 2, "frames": 8, "views": 4, "stills": 6, "samples": 4, "points": 256}
        return replace(self, resolution=(64, 64), still_resolution=(96, 96), **small)  # type: ignore[arg-type]

    @property
    def view_names(self) -> list[str]:
        """Names of the cameras, those to train on first."""
        return [f"cam_{i}" for i in range(self.views)]


_RANGES = (
    ("sequences", 1, 1000), ("frames", 2, 10000), ("views", 1, 64), ("heldout", 0, 63), ("stills", 1, 10000),
    ("resolution", 8, 8192), ("still_resolution", 8, 8192), ("samples", 1, 65536), ("points", 1, 100_000),
    ("amplitude", 0.5, 30.0), ("stiffness", 0.05, 0.999), ("bend", 0.0, 10.0), ("damping", 0.0, 50.0),
    ("speed", 0.02, 1.0), ("steps", 1, 1000), ("seed", 0, 2**31 - 1),
)  # fmt: skip


def dataset_facts(plan: Plan, surface: Surface) -> dict[str, Any]:
    """``dataset.json``."""
    names, height = plan.view_names, float(surface.vertices[:, 2].max())
    trained = plan.views - plan.heldout
    layers = cage(surface)["points"][2]
    return {
        "name": plan.name, "fps": FPS, "frames": plan.frames, "sequences": plan.sequences,
        "views": names, "train_views": names[:trained], "heldout_views": names[trained:],
        "train_frames": [0, min(TRAINED_FRAMES, plan.frames)], "object_diagonal": surface.diagonal,
        "pinned_below_z": round(height * (PINNED_LAYERS - 1) / (layers - 1), 3),
        "alpha": "straight; foreground is alpha > 0", "seed": plan.seed,
    }  # fmt: skip


def cage(surface: Surface) -> dict[str, Any]:
    """The lattice around the surface, with cells that are about as long as wide."""
    low, high = surface.vertices.min(0).astype(np.float64), surface.vertices.max(0).astype(np.float64)
    extent = high - low
    points = np.clip(np.rint(extent / extent.max() * (MOST_POINTS - 1)) + 1, FEWEST_POINTS, MOST_POINTS).astype(int)
    # A flat object has a cage that is not: a lattice without volume moves nothing.
    around = np.maximum(extent, 0.05 * SIZE) * CAGE_MARGIN
    return {
        "points": points.tolist(), "center": ((low + high) / 2).tolist(), "spacing": (around / (points - 1)).tolist(),
        "pinned_layers": PINNED_LAYERS,
    }  # fmt: skip


def action(plan: Plan, surface: Surface, number: int) -> dict[str, Any]:
    """What happens in a sequence: a poke is local, a drag moves a wide region, a double is two pokes at once."""
    rng = np.random.default_rng([plan.seed, 2, number])
    kind, sites = KINDS[number % len(KINDS)], _sites(surface)
    first = number % len(sites)
    chosen = [first]
    if kind == "double" and len(sites) > 1:
        chosen.append((first + int(rng.integers(1, len(sites)))) % len(sites))
    pushes = []
    for site in chosen:
        angle, lift = rng.uniform(0, 2 * math.pi), rng.uniform(-0.35, 0.35)
        direction = (math.cos(lift) * math.cos(angle), math.cos(lift) * math.sin(angle), math.sin(lift))
        point = sites[site] + rng.uniform(-0.06, 0.06, 3) * SIZE
        pushes.append({"point": [round(v, 4) for v in point.tolist()], "direction": [round(v, 4) for v in direction]})
    amplitude = rng.uniform(*plan.amplitude) / 100 * surface.diagonal
    return {"kind": kind, "pushes": pushes, "falloff": FALLOFF[kind], "amplitude": round(float(amplitude), 4)}


def _sites(surface: Surface) -> np.ndarray:
    """Where pushes act: places (S, 3) on the upper part of the surface, far from each other."""
    points = surface.vertices[surface.gt_ids].astype(np.float64)
    upper = points[points[:, 2] >= 0.4 * points[:, 2].max()]
    return upper[farthest_points(upper, SITES)]


def video_poses(plan: Plan, surface: Surface) -> list[list[list[float]]]:
    """Camera to world (OpenGL axes) of each view: all around, those held out between the others and higher."""
    trained = plan.views - plan.heldout
    angles = [(20.0 + 360 * i / trained, TRAIN_ELEVATIONS[i % len(TRAIN_ELEVATIONS)]) for i in range(trained)]
    between = 20.0 + 180 / trained
    angles += [(between + 360 * i / plan.heldout, HELDOUT_ELEVATION) for i in range(plan.heldout)]
    distance = _distance(surface)
    return [_pose(surface, math.radians(a), math.radians(e), distance) for a, e in angles]


def still_poses(plan: Plan, surface: Surface) -> list[list[list[float]]]:
    """Camera to world of each still, spread evenly over the upper dome."""
    highest, distance = math.sin(math.radians(STILL_ELEVATION)), _distance(surface)
    elevations = [math.asin((i + 0.5) / plan.stills * highest) for i in range(plan.stills)]
    return [_pose(surface, i * GOLDEN_ANGLE, elevation, distance) for i, elevation in enumerate(elevations)]


def _distance(surface: Surface) -> float:
    """From which the object fills the shorter side of an image, with room for its motion [scene units]."""
    radius = float(np.linalg.norm(surface.vertices - _center(surface), axis=1).max())
    return ROOM * radius / math.sin(FIELD_OF_VIEW / 2)


def _center(surface: Surface) -> np.ndarray:
    return np.array([0.0, 0.0, float(surface.vertices[:, 2].max()) / 2])


def _pose(surface: Surface, azimuth: float, elevation: float, distance: float) -> list[list[float]]:
    back = np.array([
        math.cos(elevation) * math.sin(azimuth), -math.cos(elevation) * math.cos(azimuth), math.sin(elevation),
    ])  # fmt: skip
    right = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(back, right), back
    pose[:3, 3] = _center(surface) + distance * back
    matrix: list[list[float]] = pose.tolist()
    return matrix


def camera(size: tuple[int, int]) -> dict[str, Any]:
    """A pinhole camera of a width and height [pixels], 40 degrees wide along the shorter one."""
    focal = 0.5 * min(size) / math.tan(FIELD_OF_VIEW / 2)
    return {"size": list(size), "focal": focal, "angle_x": 2 * math.atan(size[0] / (2 * focal))}


def intrinsics(size: tuple[int, int]) -> dict[str, Any]:
    """The same as fields of ``transforms.json``."""
    seen = camera(size)
    return {
        "camera_model": "OPENCV", "camera_angle_x": seen["angle_x"], "fl_x": seen["focal"], "fl_y": seen["focal"],
        "cx": size[0] / 2, "cy": size[1] / 2, "w": size[0], "h": size[1],
    }  # fmt: skip


def still_job(plan: Plan, surface: Surface, root: Path, numbers: range) -> dict[str, Any]:
    """The job of some stills."""
    poses = still_poses(plan, surface)
    images = [{"file": str(root / "static" / still_name(i)), "frame": None, "pose": poses[i]} for i in numbers]
    return {**_job(plan, surface, root, plan.still_resolution), "motion": None, "images": images}


def sequence_job(plan: Plan, surface: Surface, root: Path, number: int) -> dict[str, Any]:
    """The job of one sequence: its motion and all its pictures."""
    folder = root / "sequences" / sequence_name(number)
    poses = video_poses(plan, surface)
    images = [
        {"file": str(folder / frame_name(view, frame)), "frame": frame, "pose": pose}
        for frame in range(plan.frames)
        for view, pose in zip(plan.view_names, poses, strict=True)
    ]
    soft = {name: getattr(plan, name) for name in ("stiffness", "bend", "damping", "speed", "steps")}
    motion = {
        **action(plan, surface, number), "file": str(folder / "ground_truth.npz"), "frames": plan.frames,
        "trial_frames": TRIAL_FRAMES, "substeps": SUBSTEPS, "push_ticks": PUSH_TICKS, "soft": soft,
    }  # fmt: skip
    return {**_job(plan, surface, root, plan.resolution), "motion": motion, "images": images}


def _job(plan: Plan, surface: Surface, root: Path, size: tuple[int, int]) -> dict[str, Any]:
    return {
        "task": "make", "rest": str(root / "rest_mesh.npz"), "cage": cage(surface), "camera": camera(size),
        "samples": plan.samples,
    }  # fmt: skip


def sequence_name(number: int) -> str:
    """Folder of a sequence."""
    return f"seq_{number:03d}"


def frame_name(view: str, frame: int) -> str:
    """A frame's file within its sequence."""
    return f"{view}/{frame:04d}.png"


def still_name(number: int) -> str:
    """A still's file within ``static``."""
    return f"images/{number:04d}.png"
