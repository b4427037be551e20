"""`gausim reconstruct`: fits the Gaussians of the rest scene to posed RGBA stills."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gausim.cli.arguments import add_pin_option, add_threads_option, command_parser, pinned_by
from gausim.cli.output import bars
from gausim.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from gausim.core import GaussianScene, Renderer
    from gausim.reconstruction.reconstruction import ReconstructionOptions
    from gausim.reconstruction.stills import ImageSet, Material


# Images side by side in the comparison picture.
COMPARED = 5
LEFT_OUT_COMPARED = 2


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    if (arguments.root is None) == (arguments.transforms is None):
        raise ConfigError("expected either ROOT (a data set's directory) or --transforms FILE, got both or neither.")
    if arguments.root is not None:
        source = Path(arguments.root) / "dataset.json"
    else:
        source = Path(arguments.transforms)
    print(fit_scene(source, Path(arguments.out or source.parent / "scene.ply"), arguments)[1])
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("reconstruct")
    add = parser.add_argument
    add("root", nargs="?", metavar="ROOT", help="directory of the object (dataset.json, static/, sequences/)")
    add("--transforms", metavar="FILE", help="take the stills of this transforms.json, where there is no data set")
    add("--out", metavar="SCENE.ply", help="write this scene (default: ROOT/scene.ply)")
    add_fit_options(parser)
    add_pin_option(parser)
    return parser


def fit_scene(source: Path, out: Path, arguments: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Reconstructs a scene and writes it to ``out``, with figures (JSON) and a picture (PNG) beside it.

    ``source`` is ``dataset.json`` of an object or ``transforms.json`` of stills; ``arguments`` are those of
    :func:`add_fit_options` and :func:`gausim.cli.arguments.add_pin_option`. Returns the figures as plain data and
    as text.

    Raises:
        DataError: images, poses or masks are unusable.
        SceneError: the pins select no kernel.
    """
    import torch

    from gausim.io.files import write_json
    from gausim.io.ply import save_scene
    from gausim.reconstruction.stills import measure
    from gausim.render.cpu import CpuRenderer

    torch.set_num_threads(arguments.threads)
    options = _options(arguments)
    name, material, below_z = _inputs(source, arguments)
    renderer = CpuRenderer()
    start = time.process_time()
    scene = pinned_by(_fit(material, renderer, options, name), arguments.pin, below_z=below_z)
    seconds = time.process_time() - start
    save_scene(scene, out)
    record = {
        "kernels": scene.count,
        "pinned": int(scene.pinned.sum()),
        "diagonal": scene.diagonal,
        "measured": {s.name: {"images": len(s.images), **measure(scene, renderer, s)} for s in material.measure},
        "options": asdict(options),
    }
    write_json(out.with_suffix(".json"), record)
    _compare(scene, renderer, material.measure, out.with_suffix(".png"))
    return record, _told(record, out, seconds)


def add_fit_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the reconstruction."""
    add = parser.add_argument
    add("--kernels", type=int, default=2000, metavar="N", help="aim at N Gaussians (default %(default)s)")
    add("--iterations", type=int, default=4000, metavar="N", help="make N optimiser steps, one image each (default "
        "%(default)s)")  # fmt: skip
    add("--sh-degree", type=int, default=1, choices=(0, 1, 2, 3), help="harmonics of this degree (default %(default)s)")
    add("--anisotropy", type=float, default=3.0, metavar="R", help="penalise a length over width of a kernel above R "
        "(default %(default)s)")  # fmt: skip
    add("--missing-masks", type=float, default=0.0, metavar="FRACTION", help="let this fraction of the stills "
        "have masks that lack a part that all others show (default %(default)s)")  # fmt: skip
    add("--video-share", type=float, default=0.5, metavar="FRACTION",
        help="make this fraction of the steps at the size of the videos, on reduced stills and on frame 0 "
        "of the training views; 0 uses the stills only (with ROOT; default %(default)s)")  # fmt: skip
    add("--longest", type=int, metavar="PIXELS", help="reduce the stills of --transforms to this length of "
        "their longer side")  # fmt: skip
    add("--leave-out", type=int, default=10, metavar="N", help="leave one still of --transforms in N out for "
        "evaluation (default %(default)s)")  # fmt: skip
    add_threads_option(parser)
    add("--seed", type=int, default=0, help="draw random numbers with this seed (default %(default)s)")


def _options(arguments: argparse.Namespace) -> ReconstructionOptions:
    from gausim.reconstruction.reconstruction import ReconstructionOptions

    return ReconstructionOptions(
        kernels=arguments.kernels, anisotropy_limit=arguments.anisotropy, iterations=arguments.iterations,
        sh_degree=arguments.sh_degree, missing_masks=arguments.missing_masks, seed=arguments.seed,
    )  # fmt: skip


def _inputs(source: Path, arguments: argparse.Namespace) -> tuple[str, Material, float | None]:
    """Name, images, and the height below which the data set has its pins."""
    from gausim.data.objects import ObjectData
    from gausim.reconstruction.stills import gather_object, gather_stills

    if not 0 <= arguments.video_share < 1:
        raise DataError(f"--video-share: expected a fraction in [0, 1), got {arguments.video_share}.")
    if arguments.leave_out < 2:
        raise DataError(f"--leave-out: expected one still in 2 or more, got {arguments.leave_out}.")
    if source.name == "dataset.json":
        data = ObjectData(source.parent)
        material = gather_object(data, video_fraction=arguments.video_share)
        return data.name, material, data.pinned_below_z
    material = gather_stills(source, every=arguments.leave_out, longest=arguments.longest, coarse=0.5)
    return source.parent.name or "scene", material, None


def _fit(material: Material, renderer: Renderer, options: ReconstructionOptions, name: str) -> GaussianScene:
    from rich.progress import TextColumn, TimeRemainingColumn

    from gausim.reconstruction.reconstruction import Reconstruction, reconstruct

    state = TextColumn("{task.completed}/{task.total}  {task.fields[state]}")
    with bars(state, TimeRemainingColumn()) as bar:
        task = bar.add_task("reconstruct", total=options.iterations, state="placing the first kernels")

        def show(run: Reconstruction) -> None:
            bar.update(task, completed=run.done, state=f"loss {run.loss:.5f}  kernels {run.splats.count}")

        return reconstruct(material.train, renderer, options, name=name, progress=show)


def _compare(scene: GaussianScene, renderer: Renderer, sets: tuple[ImageSet, ...], path: Path) -> None:
    """Draws truth, rendering and four times the difference (rows) of held-out and then training stills (columns)."""
    from gausim.data.images import composite
    from gausim.pictures.figures import picture_grid
    from gausim.render.draw import draw_still, to_bytes

    size = sets[0].cameras.width, sets[0].cameras.height
    alike = [s for s in sets if (s.cameras.width, s.cameras.height) == size]
    counts = (LEFT_OUT_COMPARED, COMPARED - LEFT_OUT_COMPARED) if len(alike) > 1 else (COMPARED,)
    rows: dict[str, list[Any]] = {"truth": [], "rendering": [], "4 x difference": []}
    for images, count in zip(alike, counts, strict=False):
        total = len(images.images)
        chosen = images.select(sorted({i * total // count for i in range(count)}))
        truth, drawn = composite(chosen.images)[0], draw_still(renderer, scene, chosen.cameras).rgb[0].clamp(0, 1)
        for row, pictures in zip(rows.values(), (truth, drawn, 4 * (drawn - truth).abs()), strict=True):
            row += [to_bytes(picture).numpy() for picture in pictures]
    labels = [label for label, row in rows.items() for _ in row]
    picture_grid(sum(rows.values(), []), labels, path, title=scene.name, columns=len(rows["truth"]))


def _told(record: dict, out: Path, seconds: float) -> str:
    lines = [f"{record['kernels']} kernels, {record['pinned']} pinned, {seconds:.0f} CPU-s"]
    lines.append(f"{'measured on':<34} {'images':>6} {'PSNR':>8} {'foreground':>11} {'SSIM':>7}")
    for name, row in record["measured"].items():
        decibel = f"{row['psnr']:>5.2f} dB {row['psnr_foreground']:>8.2f} dB"
        lines.append(f"{name:<34} {row['images']:>6} {decibel} {row['ssim']:>7.4f}")
    lines.append(f"scene      {out}\npicture    {out.with_suffix('.png')} (truth, rendering, 4 x difference)")
    return "\n".join(lines)
