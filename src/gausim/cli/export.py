"""`gausim export`: conversion of motions to and from files of other programs."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from gausim.cli.arguments import (
    add_data_option,
    add_device_options,
    add_names,
    command_parser,
    computing,
    parse_background,
    positive,
)
from gausim.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    import numpy as np
    import torch

    from gausim.core import Cameras, GaussianScene, Renderer, Trajectory


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion to export."""

    name: str  # base name of the files
    fps: float  # frames per second
    frames: int  # number of frames
    scenes: Callable[[], Iterator[GaussianScene]]  # generator function of the deformed scenes
    first: GaussianScene  # the first deformed scene, or the rest scene
    trajectory: Trajectory | None = None  # the motion as a trajectory, if it was read as one
    cameras: Cameras | None = None  # cameras of the data set, if any
    renderer: Renderer | None = None  # renderer of the run, if any
    device: torch.device | str = "cpu"  # where pictures are drawn


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    computing(arguments)
    if arguments.format == "page":
        return _page(arguments)
    motion = _thinned(_opened(arguments), arguments.every)
    path = arguments.out or Path(f"{motion.name}{FORMATS[arguments.format].suffix}")
    count = _write(motion, path, arguments)
    print(f"wrote {path}: {count} frames of {motion.first.count} kernels at {motion.fps:g} frames per second")
    return 0


def _parser() -> argparse.ArgumentParser:
    rows = [f"  {name:<12} {form.keeps}; loses {form.loses}" for name, form in FORMATS.items()]
    parser = command_parser("export", epilog="formats and what they keep:\n" + "\n".join(rows))
    add = parser.add_argument
    add("source", metavar="SOURCE", type=Path, help="a RUN; a trajectory.safetensors (with --scene); or a folder of "
        "name_0001.ply, ...")  # fmt: skip
    add("--format", required=True, choices=list(FORMATS), help="write this format, see below")
    add("--out", metavar="PATH", type=Path, help="write this file, of ply and gltf this folder (default: NAME.SUFFIX)")
    add("--scene", type=Path, metavar="SCENE.ply", help="take this rest scene of a trajectory")
    add_names(parser, "objects", "export this object of a run (default: its first)", several=False)
    add_names(parser, "sequences", "export this sequence of a run (default: its first)", several=False)
    add_data_option(parser)
    add("--frames", type=positive, metavar="N", help="predict N frames (default: as many as were recorded)")
    add("--every", type=positive, default=1, metavar="N", help="take every N-th frame (default: 1)")
    add("--fps", type=float, help="play a folder of PLY files so fast [frames / s] (default: as it says)")
    add("--up", default="z", choices=("y", "z"), help="point the vertical axis so (default: z)")
    add_device_options(parser)
    pictures = parser.add_argument_group("mp4, gif, html and page")
    add_names(pictures, "cameras", "look from this camera of the run's data set (default: --azimuth)", several=False)
    pictures.add_argument("--azimuth", type=float, default=30.0, metavar="DEGREE", help="look from this side "
                          "(default: 30)")  # fmt: skip
    pictures.add_argument("--size", type=positive, default=480, metavar="PIXELS", help="draw mp4 and gif in this "
                          "height and width (default: 480)")  # fmt: skip
    pictures.add_argument("--background", default="black", metavar="COLOR", help="draw on black, white or R,G,B in "
                          "0..1 (default: black)")  # fmt: skip
    return parser


def _page(arguments: argparse.Namespace) -> int:
    """Writes the page that simulates an object."""
    from gausim.compose.build import load_run
    from gausim.compose.data_paths import data_option
    from gausim.compose.page import elastic_page
    from gausim.compose.predict import run_object, state_of
    from gausim.io.page import save_page

    run = load_run(arguments.source, data=data_option(arguments.data), device="cpu")
    state_of(run)
    item = run_object(run, arguments.objects)
    page, share = elastic_page(run, item)
    path = arguments.out or Path(f"{item.data.name}.html")
    cameras = item.data.sequences[0].cameras
    motion = Motion(item.data.name, page.fps, 0, lambda: iter(()), item.scene, cameras=cameras)
    background = parse_background(arguments.background)
    sizes = save_page(path, page, _camera(motion, arguments), up=arguments.up, background=background)
    parts = ", ".join(f"{name} {size / 1e6:.2f}" for name, size in sizes.items())
    print(f"wrote {path}: {page.scene.count} kernels, {len(page.centres)} units; MB: {parts}\n{share}")
    return 0


def _opened(arguments: argparse.Namespace) -> Motion:
    from gausim.io.ply_sequence import load_ply_sequence

    source: Path = arguments.source
    if source.is_dir() and not (source / "config.yaml").is_file():
        scenes, count, fps = load_ply_sequence(source, fps=arguments.fps)
        return Motion(source.name, fps, count, lambda: load_ply_sequence(source, fps=fps)[0], next(scenes))
    if source.suffix == ".safetensors":
        return _from_trajectory(source, arguments.scene)
    return _from_run(arguments)


def _from_trajectory(source: Path, scene_path: Path | None) -> Motion:
    from gausim.io.ply import load_scene
    from gausim.io.trajectory import load_trajectory

    if scene_path is None:
        raise ConfigError(f"{source}: a trajectory has no appearance; name its rest scene with --scene SCENE.ply.")
    trajectory, scene = load_trajectory(source), load_scene(scene_path)
    if trajectory.positions.shape[1] != scene.count:
        raise DataError(f"{source}: has {trajectory.positions.shape[1]} kernels, but {scene_path} has {scene.count}.")
    return _of_trajectory(source.stem, scene, trajectory)


def _from_run(arguments: argparse.Namespace) -> Motion:
    from gausim.compose.build import load_run
    from gausim.compose.data_paths import data_option
    from gausim.compose.predict import run_object, state_of

    run = load_run(arguments.source, data=data_option(arguments.data), device=arguments.device)
    state_of(run)
    item = run_object(run, arguments.objects)
    record = item.sequence(arguments.sequences or item.data.sequences[0].name)
    trajectory = item(record, arguments.frames).to("cpu")
    motion = _of_trajectory(f"{item.data.name}_{record.name}", item.scene, trajectory)
    return replace(motion, cameras=record.cameras, renderer=run.renderer, device=run.device)


def _of_trajectory(name: str, scene: GaussianScene, trajectory: Trajectory) -> Motion:
    from gausim.ops.deformed_scene import deformed_scene

    def scenes() -> Iterator[GaussianScene]:
        for state in zip(trajectory.positions, trajectory.deformation_gradients, trajectory.rotations, strict=True):
            yield deformed_scene(scene, *state, trajectory.unit_of_kernel)

    return Motion(name, trajectory.fps, trajectory.frames, scenes, scene, trajectory)


def _thinned(motion: Motion, every: int) -> Motion:
    trajectory = motion.trajectory
    if trajectory is not None:
        trajectory = trajectory.part(slice(None, None, every))
    return replace(
        motion,
        fps=motion.fps / every,
        frames=len(range(0, motion.frames, every)),
        scenes=lambda: islice(motion.scenes(), 0, None, every),
        trajectory=trajectory,
    )


def _write(motion: Motion, path: Path, arguments: argparse.Namespace) -> int:
    """Writes the motion; returns the number of frames."""
    scene, trajectory, up = motion.first, motion.trajectory, arguments.up
    match arguments.format:
        case "ply":
            from gausim.io.ply_sequence import save_ply_sequence

            return len(save_ply_sequence(path, motion.name, motion.scenes(), motion.fps))
        case "gltf":
            from gausim.io.gltf import save_gltf_frames

            return save_gltf_frames(path, motion.name, motion.scenes(), up=up)
        case "usd":
            from gausim.io.usd import save_usd

            return save_usd(path, motion.scenes(), motion.fps, up=up)
        case "mp4" | "gif":
            from gausim.io.video import write_gif, write_video

            write = write_gif if arguments.format == "gif" else write_video
            return write(path, _pictures(motion, arguments), motion.fps)
    if trajectory is None:
        raise ConfigError(
            f"--format {arguments.format}: {arguments.source} holds frames without units, which make no trajectory. "
            "Export from a run or a trajectory, or as ply, gltf, usd, mp4 or gif."
        )
    match arguments.format:
        case "safetensors":
            from gausim.io.trajectory import save_trajectory

            save_trajectory(path, trajectory, facts={"object": scene.name})
        case "motion":
            from gausim.io.motion import save_motion

            save_motion(path, scene, trajectory, up=up)
        case "html":
            from gausim.io.player import save_player

            background, camera = parse_background(arguments.background), _camera(motion, arguments)
            save_player(path, scene, trajectory, camera, up=up, background=background)
    return motion.frames


def _pictures(motion: Motion, arguments: argparse.Namespace) -> Iterator[np.ndarray]:
    from gausim.compose.config import compose, instantiate
    from gausim.render.draw import draw_still, to_bytes

    background, camera = parse_background(arguments.background), _camera(motion, arguments)
    renderer = motion.renderer or instantiate(compose(["render=cpu"]).render)
    for scene in motion.scenes():
        made = draw_still(
            renderer,
            scene.to(motion.device),
            camera,
            background=background,
            mask=motion.first.foreground.to(motion.device),
        )
        yield to_bytes(made.rgb[0, 0]).cpu().numpy()


def _camera(motion: Motion, arguments: argparse.Namespace) -> Cameras:
    from gausim.ops.orbit import orbit_cameras

    if arguments.cameras is None:
        size = (arguments.size, arguments.size)
        means = motion.first.means[motion.first.foreground]
        return orbit_cameras(means, azimuths=[arguments.azimuth], up=arguments.up, size=size)
    names = [] if motion.cameras is None else list(motion.cameras.names)
    if motion.cameras is None or arguments.cameras not in names:
        raise DataError(
            f"--cameras {arguments.cameras}: expected one of {names} (cameras of a run's data set), or --azimuth."
        )
    return motion.cameras.select([names.index(arguments.cameras)])


class Format(NamedTuple):
    """A file format: suffix (empty for a folder), content that it keeps and loses."""

    suffix: str
    keeps: str
    loses: str


FORMATS = {
    "safetensors": Format(".safetensors", "every number of the trajectory, bit for bit", "the rest scene"),
    "ply": Format("", "a 3DGS PLY per frame, with turned spherical harmonics and masks", "units and their deformation"),
    "motion": Format(".motion.glb", "rest scene, and 12 half floats per unit and frame", "digits beyond a thousandth"),
    "html": Format(".html", "as motion, in one page that plays in a browser without a network", "as motion"),
    "page": Format(".html", "the learned template, to be pulled in a browser without a network", "the network"),
    "gltf": Format("", "a GLB per frame (KHR_gaussian_splatting)", "masks, units, frame rate"),
    "usd": Format(".usdc", "a ParticleField3DGaussianSplat with time samples", "masks, units"),
    "mp4": Format(".mp4", "pictures of one camera", "everything else"),
    "gif": Format(".gif", "pictures of one camera, 256 colours", "everything else"),
}
