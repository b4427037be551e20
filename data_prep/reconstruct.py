"""Fits the Gaussians of the rest scene to posed stills.

ROOT is what `segment` or `poses` wrote (transforms.json with its pictures), or an object (dataset.json). With masks the
kernels cover the object, within the visual hull of the masks; with --extent scene everything in the photos, beginning
with the points that `poses` found. The result is OUT/scene.ply, OUT/scene.json (PSNR and SSIM, also on stills left out)
and OUT/scene.png: look at it. `gausim reconstruct` does the same without a manifest.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from data_prep.common.command import headline, run_command, stage_parser
from data_prep.common.progress import Tick
from data_prep.common.stage import Stage, run_stage
from gausim.cli.arguments import add_pin_options
from gausim.cli.reconstruct import add_fit_options, fit_scene
from gausim.core.errors import DataError

# Raise when the same inputs and settings give another result than before.
REVISION = 1
# Arguments that change how fast the result comes, not what it is, or where it goes.
_OUTSIDE = ("root", "out", "force", "threads", "points")
PACKAGES = ("torch", "numpy", "numba", "opencv-python-headless", "safetensors")


def reconstruct(root: Path, out: Path, arguments: argparse.Namespace, *, force: bool = False) -> dict[str, Any]:
    """Runs the stage.

    Raises:
        DataError: images, poses, masks or points are unusable.
        SceneError: the pins select no kernel.
    """
    source = next((root / name for name in ("dataset.json", "transforms.json") if (root / name).is_file()), None)
    if source is None:
        raise DataError(
            f"{root}: neither dataset.json nor transforms.json is here. Expected what `segment` or `poses` wrote."
        )
    settings = {key: value for key, value in vars(arguments).items() if key not in _OUTSIDE}
    settings = {key: str(value) if isinstance(value, Path) else value for key, value in settings.items()}
    stage = Stage("reconstruct", REVISION, _files(source, arguments), settings, PACKAGES)

    def make(work: Path) -> Mapping[str, Any]:
        return fit_scene(source, work / "scene.ply", arguments)[0]

    return run_stage(stage, out, make, force=force)


def _files(source: Path, arguments: argparse.Namespace) -> dict[str, Path]:
    """Everything that is read, by its name below the source's folder."""
    from gausim.io.transforms import read_transforms

    root = source.parent
    files = [source]
    if source.name == "dataset.json":
        files += sorted(
            p for p in root.rglob("*") if p.is_file() and p.relative_to(root).parts[0] in ("static", "sequences")
        )
    else:
        files += [frame.path for frame in read_transforms(source).frames]
    points = Path(arguments.points) if arguments.points else root / "points.npz"
    named = {str(path.relative_to(root)): path for path in files}
    return {**named, "points": points} if arguments.points or points.is_file() else named


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("reconstruct", __doc__)
    parser.add_argument("root", type=Path, metavar="ROOT", help="folder with transforms.json or dataset.json")
    add_fit_options(parser)
    add_pin_options(parser)

    def run(given: argparse.Namespace, tick: Tick) -> str:
        manifest = reconstruct(given.root, given.out, given, force=given.force)
        results = manifest["results"]
        lines = [f"{name}: {row['psnr']:.2f} dB, foreground {row['psnr_foreground']:.2f} dB, SSIM {row['ssim']:.3f}"
                 for name, row in results["measured"].items()]  # fmt: skip
        kernels = f"{results['kernels']} kernels"
        return "\n".join([headline(given.out, manifest), kernels, *lines, f"look at {given.out / 'scene.png'}"])

    return run_command(parser, argv, run)
