"""One synthetic object on disk: its rest scene, stills and sequences, in the layout that gausim.data reads."""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from data_prep.synthetic.bodies import BODIES, Array, Body
from data_prep.synthetic.elastic import ElasticBody, Material
from data_prep.synthetic.embedding import Embedding, cover_surface, embedded_scene
from data_prep.synthetic.paint import PAINTERS
from data_prep.synthetic.pushes import SMALL_SWING, pushed_motion, random_push
from data_prep.synthetic.rig import VIDEO_ANGLES, photograph, still_cameras, video_cameras
from gausim.core import Cameras, ConfigError, GaussianScene
from gausim.data.images import write_rgba
from gausim.io.files import write_json
from gausim.io.ply import save_scene
from gausim.io.transforms import write_transforms

TRAIN_FRAMES = 16  # frames 0..15 are seen, as the paper trains
MIN_KERNELS = 50
LARGEST_SWING = 0.5  # [diagonals]; further the finite elements turn inside out


@dataclass(frozen=True)
class Recipe:
    """What an object is.

    Attributes:
        body: a shape of :data:`BODIES`.
        material: what it is made of.
        time_step: that its stiffness allows [s].
        swing: least and largest amplitude of its pushes [diagonals].
    """

    body: str
    material: Material
    time_step: float
    swing: tuple[float, float] = SMALL_SWING


# Periods of the slowest mode are about 14 frames (soft) and 9 frames (firm) at 24 frames per second.
SOFT_PUDDING = Recipe("pudding", Material(young_modulus=170.0, poisson_ratio=0.35, drag=0.5), 2e-3)
SOFT_FLOWER = Recipe("flower", Material(young_modulus=8e4, poisson_ratio=0.35, drag=0.5), 2e-4)
# Pushes that bend a body far beyond where its motion is linear.
LARGE_SWING = (0.18, 0.28)
RECIPES = {
    "pudding_soft": SOFT_PUDDING,
    "pudding_firm": Recipe("pudding", Material(young_modulus=400.0, poisson_ratio=0.35, drag=0.5), 2e-3),
    "flower_soft": SOFT_FLOWER,
    "flower_firm": Recipe("flower", Material(young_modulus=1.7e5, poisson_ratio=0.35, drag=0.5), 1.5e-4),
    "pudding_swing": replace(SOFT_PUDDING, swing=LARGE_SWING),
    "flower_swing": replace(SOFT_FLOWER, swing=LARGE_SWING),
}


@dataclass(frozen=True)
class Plan:
    """Size of a data set.

    Attributes:
        objects: names of :data:`RECIPES`.
        sequences: per object; pokes and drags take turns.
        frames: per sequence.
        fps: frames per second.
        train_views: cameras to train on (a held-out one is added).
        stills: images of the rest state per object.
        resolution: of the videos [pixels].
        still_resolution: of the stills [pixels].
        kernels: Gaussians per object.
        swing: least and largest amplitude of all pushes [diagonals]; None: each object's own.
        seed: of everything random.
    """

    objects: tuple[str, ...] = ("pudding_soft", "pudding_firm", "flower_soft", "flower_swing", "pudding_swing")
    sequences: int = 8
    frames: int = 50
    fps: int = 24
    train_views: int = 4
    stills: int = 24
    resolution: int = 96
    still_resolution: int = 192
    kernels: int = 800
    swing: tuple[float, float] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Checks the numbers."""
        unknown = [name for name in self.objects if name not in RECIPES]
        if unknown or not self.objects:
            raise ConfigError(f"objects: no recipe for {unknown}; choose some of {', '.join(RECIPES)}.")
        if self.frames < TRAIN_FRAMES:
            raise ConfigError(f"frames: expected at least the {TRAIN_FRAMES} that are trained on, got {self.frames}.")
        if not 1 <= self.train_views < len(VIDEO_ANGLES):
            raise ConfigError(f"train_views: expected 1..{len(VIDEO_ANGLES) - 1}, got {self.train_views}.")
        if self.kernels < MIN_KERNELS:
            raise ConfigError(f"kernels: expected at least {MIN_KERNELS} to cover a body, got {self.kernels}.")

        if self.swing is not None and not 0 < self.swing[0] <= self.swing[1] <= LARGEST_SWING:
            raise ConfigError(f"swing: expected 0 < LOW <= HIGH <= {LARGEST_SWING} diagonals, got {self.swing}.")

    @property
    def views(self) -> tuple[str, ...]:
        """Names of all cameras, the held-out one last."""
        return tuple(f"cam_{i}" for i in range(self.train_views + 1))


QUICK = replace(
    Plan(),
    objects=("pudding_soft", "flower_soft"),
    sequences=2,
    frames=20,
    stills=10,
    resolution=48,
    still_resolution=64,
    kernels=150,
)


class SyntheticObject:
    """Builds one object of a plan and writes its parts."""

    def __init__(self, name: str, plan: Plan) -> None:
        """Covers the body of a recipe with painted Gaussians."""
        self.name, self.plan, self.recipe = name, plan, RECIPES[name]
        self.body: Body = BODIES[self.recipe.body]()
        rng = self._rng("look")
        points, frames, spacing = cover_surface(self.body, plan.kernels, rng)
        self.points: Embedding = points
        rest = points.positions(self.body.nodes)
        colors = PAINTERS[self.recipe.body](rest, frames[..., 2], self.body.grid[points.cell], rng)
        self.scene: GaussianScene = embedded_scene(points, frames, spacing, colors, name=name)
        low, high = self.body.nodes.min(0), self.body.nodes.max(0)
        self.center, self.radius = (low + high) / 2, float(np.linalg.norm(high - low) / 2)

    @property
    def _swing(self) -> tuple[float, float]:
        return self.recipe.swing if self.plan.swing is None else self.plan.swing

    @cached_property
    def elastic(self) -> ElasticBody:
        """The body's finite elements."""
        recipe = self.recipe
        return ElasticBody(self.body, recipe.material, fps=self.plan.fps, time_step=recipe.time_step)

    def write_rest(self, root: Path) -> None:
        """Writes ``dataset.json``, ``scene.ply`` with masks, ``rest_points.npz`` and the stills."""
        plan = self.plan
        root.mkdir(parents=True, exist_ok=True)
        save_scene(self.scene, root / "scene.ply")
        np.savez(root / "rest_points.npz", points=self.scene.means.numpy())
        images = root / "static" / "images"
        images.mkdir(parents=True, exist_ok=True)
        cameras = still_cameras(self.center, self.radius, plan.still_resolution, plan.stills)
        still = np.zeros((1, *self.body.nodes.shape))
        pictures = self._photograph(still, cameras)[0]
        for name, picture in zip(cameras.names, pictures, strict=True):
            write_rgba(images / f"{name}.png", picture)
        entries = [{"file_path": f"images/{name}.png"} for name in cameras.names]
        write_transforms(root / "static" / "transforms.json", cameras, entries)
        write_json(root / "dataset.json", self._facts())

    def write_sequence(self, root: Path, number: int) -> None:
        """Simulates, photographs and writes sequence ``number``."""
        plan, folder = self.plan, root / "sequences" / f"seq_{number:03d}"
        push = random_push(self.body, ("poke", "drag")[number % 2], self._rng("push", number), self._swing)
        motion = pushed_motion(self.body, self.elastic, push, plan.frames)
        displacement = motion - motion[0]
        cameras = video_cameras(self.center, self.radius, plan.resolution, plan.views)
        pictures = self._photograph(displacement, cameras)
        entries, poses = [], []
        for view, name in enumerate(plan.views):
            (folder / name).mkdir(parents=True, exist_ok=True)
            for frame in range(plan.frames):
                write_rgba(folder / name / f"{frame:04d}.png", pictures[frame, view])
                entry = {"file_path": f"{name}/{frame:04d}.png", "camera": name, "frame": frame}
                entries.append({**entry, "time": frame / plan.fps, "heldout": name == plan.views[-1]})
                poses.append(view)
        write_transforms(folder / "transforms.json", cameras.select(poses), entries, fps=plan.fps)
        true = self.points.positions(displacement).astype(np.float32)
        np.savez(folder / "ground_truth.npz", displacement=true)
        write_json(folder / "meta.json", {**asdict(push), **self._figures(true)})

    def _photograph(self, displacement: Array, cameras: Cameras) -> np.ndarray:
        """(F, V, H, W, 4) images of the scene under node displacements (F, N, 3)."""
        positions = self.scene.means.numpy() + self.points.positions(displacement)
        gradients = self.points.gradients(self.body.nodes + displacement)
        return photograph(self.scene, positions, gradients, cameras).numpy()

    def _facts(self) -> dict[str, object]:
        plan = self.plan
        return {
            "name": self.name,
            "fps": plan.fps,
            "frames": plan.frames,
            "sequences": plan.sequences,
            "views": list(plan.views),
            "train_views": list(plan.views[:-1]),
            "heldout_views": [plan.views[-1]],
            "train_frames": [0, TRAIN_FRAMES],
            "resolution": plan.resolution,
            "static_views": plan.stills,
            "static_resolution": plan.still_resolution,
            "object_diagonal": self.scene.diagonal,
            "alpha": "straight; foreground mask = alpha; composite as rgb * alpha",
            "seed": plan.seed,
            "simulation": {"method": "MuJoCo flex, linear tetrahedra", "gravity": 0.0, **asdict(self.recipe)},
        }

    def _figures(self, displacement: np.ndarray) -> dict[str, object]:
        length = np.linalg.norm(displacement, axis=-1)
        percent = 100 / self.scene.diagonal
        return {
            "peak_displacement_pct_of_diagonal": round(float(length.max()) * percent, 3),
            "mean_displacement_per_frame": np.round(length.mean(1), 5).tolist(),
            "max_displacement_per_frame": np.round(length.max(1), 5).tolist(),
        }

    def _rng(self, *stream: object) -> np.random.Generator:
        """A generator of its own for every purpose, so that no part depends on the order of the others."""
        return np.random.default_rng([self.plan.seed, zlib.crc32(repr((self.name, *stream)).encode())])
