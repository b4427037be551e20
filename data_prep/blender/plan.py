"""Plan of a set made by Blender: sizes, pushes, cameras and cage, all fixed before Blender starts.

Everything follows from the plan and the surface. A job for ``blender_scene`` is plain data: ``rest`` (file of the
surface), ``cage`` (lattice), ``camera``, ``samples``, ``motion`` (what moves; None for stills) and ``images``.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.blender.meshes import SIZE, UP_AXES, Surface, farthest_points
from data_prep.common.command import Options, option
from data_prep.common.spread import dome
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
TRAIN_ELEVATIONS, HELDOUT_ELEVATION, STILL_ELEVATION = (18.0, 22.0, 16.0, 24.0), 32.0, 80.0


@dataclass(frozen=True)
class Pictures(Options):
    """Stills and sizes of a set."""

    stills: int = option(200, "make so many pictures of the rest state (200)", least=1, most=10000)
    resolution: tuple[int, int] = option(
        (540, 960),
        "draw the sequences in this size [pixels] (540 960)",
        least=8,
        most=8192,
        nargs=2,
        metavar=("W", "H"),
    )
    still_resolution: tuple[int, int] = option(
        (540, 960), "draw the stills in this size [pixels] (540 960)", least=8, most=8192, nargs=2, metavar=("W", "H")
    )
    samples: int = option(16, "trace so many light paths per pixel (16)", least=1, most=65536)


@dataclass(frozen=True)
class Soft(Options):
    """The soft body that moves the object."""

    stiffness: float = option(
        0.7, "give the soft body's springs this stiffness, below 1 (default: 0.7)", least=0.05, most=0.999
    )
    bend: float = option(5.0, "give it this resistance to bending (default: 5)", least=0, most=10)
    damping: float = option(0.02, "damp vibrations by this (default: 0.02)", least=0, most=50)
    speed: float = option(0.11, "run time in the soft body at this speed (default: 0.11)", least=0.02, most=1)
    steps: int = option(
        30, "make at least so many steps per 1/192 s; more lose less energy (default: 30)", least=1, most=1000
    )


@dataclass(frozen=True)
class Plan(Options):
    """Sizes and settings of a set; the defaults are the paper's synthetic set."""

    name: str = option("object", "name the object (default: as the mesh file)")
    up: str = option("y", "point this axis of the mesh up (default: y)", choices=UP_AXES)
    sequences: int = option(30, "make so many motions (30)", least=1, most=1000)
    frames: int = option(60, "make so many frames of each, at 24 per second (60)", least=2, most=10000)
    views: int = option(5, "film with so many cameras; the paper has 4 to 6 (5)", least=1, most=64)
    heldout: int = option(1, "never train on so many of them (1)", least=0, most=63)
    points: int = option(2048, "store the true motion of so many vertices (2048)", least=1, most=100_000)
    amplitude: tuple[float, float] = option(
        (8.0, 13.0), "draw the largest displacement of a sequence from this range [%% of the diagonal] (default: 8 13)",
        least=0.5, most=30, interval=True,
    )  # fmt: skip
    pictures: Pictures = Pictures()
    soft: Soft = Soft()
    seed: int = option(0, "draw everything random with this seed (default: 0)", least=0, most=2**31 - 1)

    def __post_init__(self) -> None:
        """Checks the fields, each and together."""
        super().__post_init__()
        if self.heldout >= self.views:
            raise ConfigError(f"--heldout: expected fewer than the {self.views} --views, got {self.heldout}.")

    def quick(self) -> Plan:
        """The same in small, for tests: 2 sequences of 8 frames."""
        small = Pictures(stills=6, resolution=(64, 64), still_resolution=(96, 96), samples=4)
        return replace(self, sequences=2, frames=8, views=4, points=256, pictures=small)

    def settings(self) -> dict[str, Any]:
        """All settings in one mapping, by the names of their options; what the manifest records."""
        flat = asdict(self)
        return flat.pop("pictures") | flat.pop("soft") | flat

    @property
    def view_names(self) -> list[str]:
        """Names of the cameras, those to train on first."""
        return [f"cam_{i}" for i in range(self.views)]


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
    """Pushes of a sequence: a poke is local, a drag moves a wide region, a double is two pokes at once."""
    rng = np.random.default_rng([plan.seed, 2, number])
    kind = KINDS[number % len(KINDS)]
    # On the upper part of the surface, far from each other.
    points = surface.vertices[surface.gt_ids].astype(np.float64)
    upper = points[points[:, 2] >= 0.4 * points[:, 2].max()]
    sites = upper[farthest_points(upper, SITES)]
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


def still_entries(plan: Plan, surface: Surface) -> list[dict[str, Any]]:
    """The stills as ``transforms.json`` lists them: from cameras that are spread evenly over the upper dome."""
    poses = _poses(surface, dome(plan.pictures.stills, STILL_ELEVATION))
    return [{"file_path": f"images/{i:04d}.png", "transform_matrix": pose} for i, pose in enumerate(poses)]


def frame_entries(plan: Plan, surface: Surface) -> list[dict[str, Any]]:
    """The frames of a sequence: from cameras all around, those held out between the others and higher."""
    trained = plan.views - plan.heldout
    angles = [(20.0 + 360 * i / trained, TRAIN_ELEVATIONS[i % len(TRAIN_ELEVATIONS)]) for i in range(trained)]
    between = 20.0 + 180 / trained
    angles += [(between + 360 * i / plan.heldout, HELDOUT_ELEVATION) for i in range(plan.heldout)]
    poses = _poses(surface, [(math.radians(azimuth), math.radians(elevation)) for azimuth, elevation in angles])
    return [
        {
            "file_path": f"{view}/{frame:04d}.png", "camera": view, "frame": frame, "time": frame / FPS,
            "heldout": i >= trained, "transform_matrix": pose,
        }
        for frame in range(plan.frames)
        for i, (view, pose) in enumerate(zip(plan.view_names, poses, strict=True))
    ]  # fmt: skip


def _poses(surface: Surface, angles: list[tuple[float, float]]) -> list[list[list[float]]]:
    """Camera to world (OpenGL axes), at azimuths and elevations [radian], where the object fills the shorter side."""
    center = np.array([0.0, 0.0, float(surface.vertices[:, 2].max()) / 2])
    radius = float(np.linalg.norm(surface.vertices - center, axis=1).max())
    distance = ROOM * radius / math.sin(FIELD_OF_VIEW / 2)
    poses = []
    for azimuth, elevation in angles:
        back = np.array([
            math.cos(elevation) * math.sin(azimuth), -math.cos(elevation) * math.cos(azimuth), math.sin(elevation),
        ])  # fmt: skip
        right = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        pose = np.eye(4)
        pose[:3] = np.column_stack((right, np.cross(back, right), back, center + distance * back))
        poses.append(pose.tolist())
    return poses


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


def still_job(plan: Plan, surface: Surface, root: Path, entries: list[dict[str, Any]]) -> dict[str, Any]:
    """The job of some stills."""
    return {**_job(plan, surface, root, root / "static", entries, plan.pictures.still_resolution), "motion": None}


def sequence_job(
    plan: Plan, surface: Surface, root: Path, number: int, entries: list[dict[str, Any]]
) -> dict[str, Any]:
    """The job of one sequence: its motion and all its pictures."""
    folder = sequence_folder(root, number)
    motion = {
        **action(plan, surface, number), "file": str(folder / "ground_truth.npz"), "frames": plan.frames,
        "trial_frames": TRIAL_FRAMES, "substeps": SUBSTEPS, "push_ticks": PUSH_TICKS, "soft": asdict(plan.soft),
    }  # fmt: skip
    return {**_job(plan, surface, root, folder, entries, plan.pictures.resolution), "motion": motion}


def _job(
    plan: Plan, surface: Surface, root: Path, folder: Path, entries: list[dict[str, Any]], size: tuple[int, int]
) -> dict[str, Any]:
    images = [
        {"file": str(folder / entry["file_path"]), "frame": entry.get("frame"), "pose": entry["transform_matrix"]}
        for entry in entries
    ]
    return {
        "task": "make", "rest": str(root / "rest_mesh.npz"), "cage": cage(surface), "camera": camera(size),
        "samples": plan.pictures.samples, "images": images,
    }  # fmt: skip


def sequence_folder(root: Path, number: int) -> Path:
    """Where a sequence is."""
    return root / "sequences" / f"seq_{number:03d}"
