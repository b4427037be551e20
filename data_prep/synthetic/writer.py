"""One synthetic object on disk: its rest scene, stills and sequences, in the layout that gausim.data reads."""

from __future__ import annotations

import zlib
from dataclasses import asdict
from functools import cached_property
from pathlib import Path

import numpy as np

from data_prep.synthetic.bodies import BODIES, Array, Body
from data_prep.synthetic.elastic import ElasticBody
from data_prep.synthetic.embedding import Embedding, cover_surface, embedded_scene
from data_prep.synthetic.hands import grip, held_path, random_path
from data_prep.synthetic.paint import paint
from data_prep.synthetic.plan import RECIPES, TRAIN_FRAMES, Plan
from data_prep.synthetic.pushes import fall_field, random_fall, random_motion
from data_prep.synthetic.rig import photograph, still_cameras, video_cameras
from gausim.core import Cameras, GaussianScene
from gausim.data.images import write_rgba
from gausim.io.files import write_json
from gausim.io.ply import save_scene
from gausim.io.transforms import write_transforms


class SyntheticObject:
    """Builds one object of a plan and writes its parts."""

    def __init__(self, name: str, plan: Plan) -> None:
        """Covers the body of a recipe with painted Gaussians."""
        self.plan, self.recipe = plan, RECIPES[name]
        self.folder, self.name = name, self.recipe.like or name
        self.body: Body = BODIES[self.recipe.body]()
        rng = self._rng("look")
        points, frames, spacing = cover_surface(self.body, plan.kernels, rng)
        self.points: Embedding = points
        rest = points.positions(self.body.nodes)
        colors = paint(self.recipe.body, rest, frames[..., 2], self.body.grid[points.cell], rng)
        self.scene: GaussianScene = embedded_scene(points, frames, spacing, colors, name=self.name)
        low, high = self.body.nodes.min(0), self.body.nodes.max(0)
        self.center, self.radius = (low + high) / 2, float(np.linalg.norm(high - low) / 2)
        self.room = self.recipe.room or (self.center, self.radius)

    @cached_property
    def elastic(self) -> ElasticBody:
        """The body's finite elements."""
        recipe = self.recipe
        return ElasticBody(
            self.body, recipe.material, fps=self.plan.fps, time_step=recipe.time_step, viscosity=recipe.viscosity,
            floor=recipe.floor, driven=recipe.hands is not None,
        )  # fmt: skip

    def write_rest(self, root: Path) -> None:
        """Writes ``scene.ply`` with masks, ``rest_points.npz``, the stills and, last, ``dataset.json``."""
        if (root / "dataset.json").is_file():
            return
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
        """Simulates, photographs and writes sequence ``number``; ``meta.json`` comes last."""
        plan, folder = self.plan, root / "sequences" / f"seq_{number:03d}"
        if (folder / "meta.json").is_file():
            return
        motion, cause = self._motion(number)
        displacement = motion - self.elastic.rest
        cameras = video_cameras(np.asarray(self.room[0]), self.room[1], plan.resolution, plan.views)
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
        if self.recipe.hands is not None:
            rest, pinned = self.scene.means.numpy(), self.scene.pinned.numpy()
            hand = (rest[pinned, 0] > 0).astype(np.int64)
            np.savez(folder / "hands.npz", points=rest[pinned] + true[:, pinned], hand=hand)
        write_json(folder / "meta.json", {**cause, **self._figures(true)})

    def _motion(self, number: int) -> tuple[Array, dict[str, object]]:
        """Positions (F, N, 3) of the nodes in a sequence, and what causes them."""
        recipe, body, frames = self.recipe, self.body, self.plan.frames
        if recipe.floor is not None:
            fall = random_fall(self._rng("fall", number))
            return self.elastic.simulate(fall_field(body, fall), frames, shift=np.array(fall.shift)), asdict(fall)
        if recipe.hands is not None:
            path = random_path(recipe.hands[number % len(recipe.hands)], self._rng("hands", number))
            steps = (frames - 1) * self.elastic.substeps
            times = np.arange(steps + 1) / (self.plan.fps * self.elastic.substeps)
            held = held_path(body, path, times)
            return self.elastic.simulate(np.zeros_like(body.nodes), frames, path=held), asdict(path)
        kind, rng = ("poke", "drag")[number % 2], self._rng("push", number)
        push, motion = random_motion(body, self.elastic, kind, rng, self.plan.swing or recipe.swing, frames)
        return motion, asdict(push)

    def _photograph(self, displacement: Array, cameras: Cameras) -> np.ndarray:
        """(F, V, H, W, 4) images of the scene under node displacements (F, N, 3)."""
        positions = self.scene.means.numpy() + self.points.positions(displacement)
        gradients = self.points.deformation_gradients(self.body.nodes + displacement)
        return photograph(self.scene, positions, gradients, cameras).numpy()

    def _facts(self) -> dict[str, object]:
        plan, recipe = self.plan, self.recipe
        gravity = 0.0 if recipe.floor is None else recipe.floor.gravity
        facts: dict[str, object] = {
            "name": self.name, "fps": plan.fps, "frames": plan.frames, "sequences": plan.sequences,
            "views": list(plan.views), "train_views": list(plan.views[:-1]), "heldout_views": [plan.views[-1]],
            "train_frames": [0, TRAIN_FRAMES if recipe.train is None else round(recipe.train * plan.frames)],
            "resolution": plan.resolution, "static_views": plan.stills, "static_resolution": plan.still_resolution,
            "object_diagonal": self.scene.diagonal,
            "alpha": "straight; foreground mask = alpha; composite as rgb * alpha", "seed": plan.seed,
            "simulation": {"method": "MuJoCo flex, linear tetrahedra", "gravity": gravity, **recipe.facts},
        }  # fmt: skip
        if recipe.floor is not None:
            floor = {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": recipe.floor.friction}
            facts |= {"free": True, "gravity": [0.0, 0.0, -gravity], "floor": floor}
        if recipe.hands is not None:
            facts["grip"] = grip(self.scene.means.numpy(), self.scene.pinned.numpy())
        return facts

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
        name = self.name if stream == ("look",) else self.folder
        return np.random.default_rng([self.plan.seed, zlib.crc32(repr((name, *stream)).encode())])
