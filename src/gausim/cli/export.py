"""`gausim export`: motions as pages, pictures and files of other programs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
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
    scene: GaussianScene  # the rest scene
    trajectory: Trajectory
    cameras: Cameras | None = None  # cameras of the data set, if any
    renderer: Renderer | None = None  # renderer of the run, if any
    device: torch.device | str = "cpu"  # where pictures are drawn

    def scenes(self) -> Iterator[GaussianScene]:
        """The deformed scene of every frame."""
        from gausim.ops.deformed_scene import deformed_scene

        made = self.trajectory
        for state in zip(made.positions, made.deformation_gradients, made.rotations, strict=True):
            yield deformed_scene(self.scene, *state, made.unit_of_kernel)


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    computing(arguments)
    if arguments.format == "page":
        return _page(arguments)
    motion = _opened(arguments)
    motion = replace(motion, trajectory=motion.trajectory.part(slice(None, None, arguments.every)))
    path, made = arguments.out or Path(f"{motion.name}{FORMATS[arguments.format].suffix}"), motion.trajectory
    _write(motion, path, arguments)
    print(f"wrote {path}: {made.frames} frames of {motion.scene.count} kernels at {made.fps:g} frames per second")
    return 0


def _parser() -> argparse.ArgumentParser:
    rows = [f"  {name:<12} {form.keeps}; loses {form.loses}" for name, form in FORMATS.items()]
    parser = command_parser("export", epilog="formats and what they keep:\n" + "\n".join(rows))
    add = parser.add_argument
    add("source", metavar="SOURCE", type=Path, help="a RUN, or a trajectory.safetensors (with --scene)")
    add("--format", required=True, choices=list(FORMATS), help="write this format, see below")
    add("--out", metavar="PATH", type=Path, help="write this file, of ply this folder (default: NAME.SUFFIX)")
    add("--scene", type=Path, metavar="SCENE.ply", help="take this rest scene of a trajectory")
    add_names(parser, "objects", "export this object of a run (default: its first)", several=False)
    add_names(parser, "sequences", "export this sequence of a run (default: its first)", several=False)
    add_data_option(parser)
    add("--frames", type=positive, metavar="N", help="predict N frames (default: as many as were recorded)")
    add("--every", type=positive, default=1, metavar="N", help="take every N-th frame (default: 1)")
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
    background, camera = parse_background(arguments.background), _camera(item.scene, cameras, arguments)
    sizes = save_page(path, page, camera, up=arguments.up, background=background)
    parts = ", ".join(f"{name} {size / 1e6:.2f}" for name, size in sizes.items())
    print(f"wrote {path}: {page.scene.count} kernels, {len(page.centres)} units; MB: {parts}\n{share}")
    return 0


def _opened(arguments: argparse.Namespace) -> Motion:
    if arguments.source.suffix == ".safetensors":
        return _from_trajectory(arguments.source, arguments.scene)
    from gausim.compose.build import load_run
    from gausim.compose.data_paths import data_option
    from gausim.compose.predict import run_object, state_of

    run = load_run(arguments.source, data=data_option(arguments.data), device=arguments.device)
    state_of(run)
    item = run_object(run, arguments.objects)
    record = item.sequence(arguments.sequences or item.data.sequences[0].name)
    trajectory = item(record, arguments.frames).to("cpu")
    name = f"{item.data.name}_{record.name}"
    return Motion(name, item.scene, trajectory, record.cameras, run.renderer, run.device)


def _from_trajectory(source: Path, scene_path: Path | None) -> Motion:
    from gausim.io.ply import load_scene
    from gausim.io.trajectory import load_trajectory

    if scene_path is None:
        raise ConfigError(f"{source}: a trajectory has no appearance; name its rest scene with --scene SCENE.ply.")
    trajectory, scene = load_trajectory(source), load_scene(scene_path)
    if trajectory.positions.shape[1] != scene.count:
        raise DataError(f"{source}: has {trajectory.positions.shape[1]} kernels, but {scene_path} has {scene.count}.")
    return Motion(source.stem, scene, trajectory)


def _write(motion: Motion, path: Path, arguments: argparse.Namespace) -> None:
    if arguments.format == "ply":
        from gausim.io.ply_sequence import save_ply_sequence

        save_ply_sequence(path, motion.name, motion.scenes(), motion.trajectory.fps)
    elif arguments.format == "usd":
        from gausim.io.usd import save_usd

        save_usd(path, motion.scenes(), motion.trajectory.fps, up=arguments.up)
    elif arguments.format == "html":
        from gausim.io.player import save_player

        background, camera = parse_background(arguments.background), _camera(motion.scene, motion.cameras, arguments)
        save_player(path, motion.scene, motion.trajectory, camera, up=arguments.up, background=background)
    else:
        from gausim.io.video import write_gif, write_video

        write = write_gif if arguments.format == "gif" else write_video
        write(path, _pictures(motion, arguments), motion.trajectory.fps)


def _pictures(motion: Motion, arguments: argparse.Namespace) -> Iterator[np.ndarray]:
    from gausim.compose.config import compose, instantiate
    from gausim.render.draw import draw_still, to_bytes

    background, camera = parse_background(arguments.background), _camera(motion.scene, motion.cameras, arguments)
    renderer = motion.renderer or instantiate(compose(["render=cpu"]).render)
    mask = motion.scene.foreground.to(motion.device)
    for scene in motion.scenes():
        made = draw_still(renderer, scene.to(motion.device), camera, background=background, mask=mask)
        yield to_bytes(made.rgb[0, 0]).cpu().numpy()


def _camera(scene: GaussianScene, cameras: Cameras | None, arguments: argparse.Namespace) -> Cameras:
    from gausim.ops.orbit import orbit_cameras

    if arguments.cameras is None:
        size = (arguments.size, arguments.size)
        return orbit_cameras(scene.means[scene.foreground], azimuths=[arguments.azimuth], up=arguments.up, size=size)
    names = [] if cameras is None else list(cameras.names)
    if cameras is None or arguments.cameras not in names:
        raise DataError(
            f"--cameras {arguments.cameras}: expected one of {names} (cameras of a run's data set), or --azimuth."
        )
    return cameras.select([names.index(arguments.cameras)])


class Format(NamedTuple):
    """A file format: suffix (empty for a folder), content that it keeps and loses."""

    suffix: str
    keeps: str
    loses: str


FORMATS = {
    "html": Format(".html", "rest scene and motion of every unit, in one page that plays it in a browser without a "
                   "network", "digits beyond a thousandth"),
    "page": Format(".html", "the learned template, to be pulled in a browser without a network", "the network"),
    "ply": Format("", "a 3DGS PLY per frame, with turned spherical harmonics and masks", "units and their deformation"),
    "usd": Format(".usdc", "an OpenUSD particle field of splats with a time sample per frame", "masks, units"),
    "mp4": Format(".mp4", "pictures of one camera", "everything else"),
    "gif": Format(".gif", "pictures of one camera, 256 colours", "everything else"),
}  # fmt: skip
