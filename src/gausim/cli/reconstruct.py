"""`gausim reconstruct`: posed RGBA stills to the Gaussians of the rest scene."""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

from gausim.cli.inspect import add_pin_options, pinned_by

if TYPE_CHECKING:
    from torch import Tensor

    from gausim.core import GaussianScene, Renderer
    from gausim.engine.reconstruction import ReconstructionOptions
    from gausim.engine.stills import ImageSet, Material

HELP = "Fit the Gaussians of the rest scene to posed stills."

# Images side by side in the comparison picture.
COMPARED = 5


def main(argv: list[str]) -> int:
    """Runs the command.

    Args:
        argv: the arguments after the command's name.

    Returns:
        The exit status.

    Raises:
        DataError: images, poses or masks are unusable.
        SceneError: the pins select no kernel.
    """
    arguments = _parser().parse_args(argv)
    import torch

    from gausim.engine.reconstruction import ReconstructionOptions
    from gausim.engine.stills import measure
    from gausim.io.ply import save_scene

    torch.set_num_threads(arguments.threads)
    options = ReconstructionOptions(
        kernels=arguments.kernels,
        iterations=arguments.iterations,
        sh_degree=arguments.sh_degree,
        random_background=arguments.background == "random",
        seed=arguments.seed,
    )
    name, material, out = _inputs(arguments)
    renderer = _renderer(arguments.renderer)
    points = _points(arguments.points)
    start, cpu = time.perf_counter(), time.process_time()
    scene = pinned_by(_fit(material, renderer, options, points, name), arguments.pin_below, arguments.pin_above)
    seconds = {"wall_seconds": time.perf_counter() - start, "cpu_seconds": time.process_time() - cpu}
    save_scene(scene, out)
    figures = {images.name: {"images": len(images.images), **measure(scene, renderer, images)}
               for images in material.measure}  # fmt: skip
    _write_json(out.with_suffix(".json"), _record(scene, options, figures, seconds))
    picture = out.with_suffix(".png")
    _compare(scene, renderer, material.measure, picture)
    _print_result(scene, figures, seconds, out, picture)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="gausim reconstruct", description=HELP)
    add = parser.add_argument
    add("root", nargs="?", metavar="ROOT", help="directory of the object (dataset.json, static/, sequences/)")
    add("--transforms", metavar="FILE", help="transforms.json of the stills, where there is no data set")
    add("--out", metavar="SCENE.ply", help="scene to write; default ROOT/scene.ply")
    add("--kernels", type=int, default=2000, help="number of Gaussians aimed at (default %(default)s)")
    add("--iterations", type=int, default=4000, help="optimiser steps, one image each (default %(default)s)")
    add("--sh-degree", type=int, default=1, choices=(0, 1, 2, 3), help="spherical harmonics (default %(default)s)")
    add("--video-share", type=float, default=0.5, metavar="S",
        help="share of the steps at the size of the videos, on reduced stills and on frame 0 of the views to train "
        "on; 0 uses the stills only (default %(default)s)")  # fmt: skip
    add("--points", metavar="FILE.npz", help="start from the array 'points' (P, 3) instead of the masks' visual hull")
    add("--background", default="random", choices=("random", "black"), help="behind training images (random)")
    add("--renderer", default="cpu", choices=("cpu", "reference"), help="default %(default)s")
    add("--threads", type=int, default=1, help="processor threads (default %(default)s)")
    add("--seed", type=int, default=0, help="of everything random (default %(default)s)")
    add_pin_options(parser)
    return parser


def _inputs(arguments: argparse.Namespace) -> tuple[str, Material, Path]:
    from gausim.core.errors import DataError
    from gausim.data.objects import ObjectData
    from gausim.engine.stills import gather_object, gather_stills

    if (arguments.root is None) == (arguments.transforms is None):
        raise DataError("expected either ROOT (a data set's directory) or --transforms FILE, got both or neither.")
    if not 0 <= arguments.video_share < 1:
        raise DataError(f"--video-share: expected a share in [0, 1), got {arguments.video_share}.")
    if arguments.root is not None:
        data = ObjectData(arguments.root)
        out = Path(arguments.out) if arguments.out else data.root / "scene.ply"
        return data.name, gather_object(data, video_share=arguments.video_share), out
    path = Path(arguments.transforms)
    out = Path(arguments.out) if arguments.out else path.parent / "scene.ply"
    return path.parent.name or out.stem, gather_stills(path), out


def _renderer(name: str) -> Renderer:
    if name == "cpu":
        from gausim.render.cpu import CpuRenderer

        return CpuRenderer()
    from gausim.render.reference import ReferenceRenderer

    return ReferenceRenderer()


def _points(path: str | None) -> Tensor | None:
    if path is None:
        return None
    import torch

    from gausim.data.records import read_array

    return torch.from_numpy(read_array(Path(path), "points")).float()


def _fit(
    material: Material, renderer: Renderer, options: ReconstructionOptions, points: Tensor | None, name: str
) -> GaussianScene:
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from gausim.engine.reconstruction import reconstruct

    state = TextColumn("{task.completed}/{task.total}  {task.fields[state]}")
    with Progress(TextColumn("reconstruct"), BarColumn(), state, TimeRemainingColumn()) as bar:
        task = bar.add_task("", total=options.iterations, state="carving the visual hull")

        def show(step: int, state: dict[str, float]) -> None:
            text = f"loss {state['loss']:.5f}  kernels {state['kernels']:.0f}"
            bar.update(task, completed=step + 1, state=text)

        return reconstruct(material.train, renderer, options, points=points, name=name, progress=show)


def _record(scene: GaussianScene, options: ReconstructionOptions, figures: dict, seconds: dict) -> dict:
    from dataclasses import asdict

    return {
        "kernels": scene.count,
        "pinned": int(scene.pinned.sum()),
        "diagonal": scene.diagonal,
        "measured": figures,
        "options": asdict(options),
        **seconds,
    }


def _write_json(path: Path, record: dict) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(json.dumps(record, indent=1) + "\n")
    temporary.replace(path)


def _compare(scene: GaussianScene, renderer: Renderer, sets: tuple[ImageSet, ...], path: Path) -> None:
    """Truth above, rendering in the middle, four times the difference below, for the first measured set."""
    import torch

    from gausim.data.images import composite, write_rgba
    from gausim.engine.stills import draw_rest

    images = sets[0]
    count = len(images.images)
    chosen = images.select([i * count // COMPARED for i in range(COMPARED)] if count > COMPARED else range(count))
    truth, _ = composite(chosen.images)
    drawn = draw_rest(scene, renderer, chosen.cameras)
    rows = [torch.cat(list(x), dim=1) for x in (truth, drawn, (4 * (drawn - truth).abs()).clamp(0, 1))]
    rgb = torch.cat(rows, dim=0)
    pixels = (torch.cat((rgb, torch.ones_like(rgb[..., :1])), -1) * 255).round().to(torch.uint8)
    write_rgba(path, pixels)


def _print_result(scene: GaussianScene, figures: dict, seconds: dict, out: Path, picture: Path) -> None:
    print(f"{scene.count} kernels, {int(scene.pinned.sum())} pinned, {seconds['cpu_seconds']:.0f} CPU-s")
    print(f"{'measured on':<34} {'images':>6} {'PSNR':>8} {'foreground':>11} {'SSIM':>7}")
    for name, row in figures.items():
        decibel = f"{row['psnr']:>5.2f} dB {row['psnr_foreground']:>8.2f} dB"
        print(f"{name:<34} {row['images']:>6} {decibel} {row['ssim']:>7.4f}")
    print(f"scene      {out}\npicture    {picture} (truth, rendering, 4 x difference)")
