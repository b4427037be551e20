"""Distance of poses from others of the same photos, after the best similarity transform of their cameras.

Both may be a transforms.json (or the result of the stage poses), a COLMAP model, or a folder of projection matrices.
Photos are told apart by their names without ending; for results of the stage poses, by the names that they came with.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_prep.capture.cameras.sources import factors, match_matrices
from data_prep.capture.cameras.world import compare
from data_prep.common.command import run_command, stage_parser
from data_prep.common.photos import list_images
from gausim.core.errors import DataError
from gausim.io.colmap import find_colmap, read_colmap
from gausim.io.plain_json import read_json


def read_poses(path: Path, images: Path | None = None) -> dict[str, np.ndarray]:
    """World-to-camera matrices (4, 4) by the photos' names without ending.

    Args:
        path: file or folder of the poses.
        images: folder of the photos, which projection matrices need for their names.

    Raises:
        DataError: it holds none, they are malformed, or two photos have the same name.
    """
    if path.is_file() or (path / "transforms.json").is_file():
        return _of_transforms(path if path.is_file() else path / "transforms.json")
    try:
        folder = find_colmap(path)
    except DataError:
        if images is None:
            raise
        found = match_matrices(path, list_images(images))
        return _by_stem({photo.name: factors(m)[1] for photo, m in found.items()}, path)
    return _by_stem({image.name: image.viewmat for image in read_colmap(folder).images}, path)


def _of_transforms(path: Path) -> dict[str, np.ndarray]:
    from gausim.io.transforms import read_entries, viewmat_of

    poses = {}
    for where, entry in read_entries(read_json(path), path):
        name = entry.get("source", entry.get("file_path"))
        if not isinstance(name, str) or name in poses:
            raise DataError(f"{where}: field 'file_path' must name an image once, got {name!r:.80}.")
        poses[name] = viewmat_of(entry, where).double().numpy()
    return _by_stem(poses, path)


def _by_stem(poses: dict[str, np.ndarray], path: Path) -> dict[str, np.ndarray]:
    short = {Path(name).stem: pose for name, pose in poses.items()}
    if len(short) < len(poses):
        raise DataError(f"{path}: photos of different folders have the same name; nothing to compare them by.")
    return short


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("compare_poses", __doc__, result=False)
    parser.add_argument("poses", type=Path, metavar="POSES", help="what is compared")
    parser.add_argument("reference", type=Path, metavar="REFERENCE", help="with what")
    parser.add_argument("--images", type=Path, metavar="DIR", help="the photos, for projection matrices")
    return run_command(parser, argv, lambda given, tick: comparison(given.poses, given.reference, given.images))


def comparison(poses: Path, reference: Path, images: Path | None) -> str:
    """Text of the distance between two sets of poses.

    Raises:
        DataError: one cannot be read, or they have fewer than three photos in common.
    """
    mine, other = (read_poses(path, images) for path in (poses, reference))
    names = sorted(set(mine) & set(other))
    if len(names) < 3:
        raise DataError(f"{reference}: has {len(names)} photos in common with {poses}, expected 3.")
    facts = compare(np.stack([mine[n] for n in names]), np.stack([other[n] for n in names]))
    return (
        f"{len(names)} photos in common ({len(mine)} and {len(other)})\n"
        f"centres      mean {facts['center_error_mean_percent']:.4f} %, largest "
        f"{facts['center_error_max_percent']:.4f} % of the largest distance between two cameras\n"
        f"orientation  mean {facts['rotation_error_mean_degree']:.4f}, largest "
        f"{facts['rotation_error_max_degree']:.4f} degrees"
    )
