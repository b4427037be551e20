"""Poses of photos and of fixed video cameras: found with COLMAP, or taken over from somebody who found them.

The result is OUT/transforms.json with undistorted images/*.png (camera to world, OpenGL axes), points.npz (points,
colours, errors) to begin a reconstruction with, cameras.png to look at, and for videos sequences/SEQ/transforms.json
with the undistorted frames. Matching takes most of the time; interrupted, it goes on where it was.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from data_prep.capture.cameras.material import Material, Sources
from data_prep.common.command import add_result, headline, told
from data_prep.common.progress import Tick, silent
from gausim.core.errors import DataError
from gausim.io.files import replacing

if TYPE_CHECKING:
    import numpy as np

    from data_prep.capture.cameras.mapping import MappingOptions
    from data_prep.capture.cameras.output import Straighteners
    from data_prep.capture.cameras.sources import Posed
    from data_prep.capture.cameras.world import Similarity
    from gausim.io.colmap_files import PointTable

# Raise when the same inputs and settings give another result than before.
REVISION = 1
PACKAGES = ("pycolmap", "numpy", "opencv-python-headless", "pillow")
# So many images are named where a camera is not among them.
_NAMED = 6
T = TypeVar("T")


@dataclass(frozen=True)
class WorldOptions:
    """The world that poses are brought to.

    Attributes:
        up: ``cameras``, ``plane``, ``keep`` or ``X,Y,Z`` in the found world.
        distances: pairs of marked points and their true distance: (point, point, metres as text).
    """

    up: str | None = None
    distances: tuple[tuple[str, str, str], ...] = ()


def find_poses(
    out: Path,
    sources: Sources,
    *,
    mapping: MappingOptions,
    world: WorldOptions | None = None,
    force: bool = False,
    tick: Tick = silent,
) -> dict[str, Any]:
    """Runs the stage.

    Args:
        out: folder of the result.
        sources: photos, videos, and poses to take over.
        mapping: how poses are found where none are taken over.
        world: up and scale.
        force: replace a result of other inputs or settings.
        tick: told of the progress.

    Returns:
        The stage's manifest.

    Raises:
        DataError: an input is missing or broken, or no poses can be found.
        ConfigError: options contradict each other.
    """
    from data_prep.common.stage import Stage, run_stage

    world = world or WorldOptions()
    material = Material.of(sources)
    settings: dict[str, Any] = {"source": sources.kind, "world": asdict(world), "fps": material.fps}
    if sources.kind == "mapping":
        settings["mapping"] = {k: v for k, v in asdict(mapping).items() if k != "threads"}
    if sources.kind == "projections":
        settings["scale"] = sources.scale
    stage = Stage("poses", REVISION, material.inputs, settings, PACKAGES)
    return run_stage(stage, out, lambda work: _make(work, sources, material, mapping, world, tick), force=force)


def _make(
    work: Path, sources: Sources, material: Material, mapping: MappingOptions, world: WorldOptions, tick: Tick
) -> dict[str, Any]:
    """Does the stage's work in ``work``."""
    from data_prep.capture.cameras.mapping import forget
    from data_prep.capture.cameras.output import Straighteners, key_of, write_points, write_stills
    from data_prep.capture.cameras.report import draw_cameras, reprojection

    found, points, results = _found(work, sources, material, mapping, tick)
    move, results["world"] = _world(found, points, world, mapped=sources.kind == "mapping")
    results["reprojection"] = reprojection(found, points)
    moved = [replace(shot, viewmat=move.viewmat(shot.viewmat)) for shot in found]
    tracks = points.tracks
    results["points"] = {"count": len(tracks), "mean_track": float(tracks.mean()) if len(tracks) else None}
    straighteners, used = Straighteners(), set[str]()
    sequences, left_out = _write_sequences(work, sources, material, moved, straighteners, used, tick)
    stills = [shot for shot in moved if key_of(shot.photo.name) not in used] or moved
    write_stills(work, stills, straighteners, tick)
    xyz = move.points(points.xyz)
    colors = _colors(found, points, sources)
    write_points(work / "points.npz", points, xyz, colors)
    with replacing(work / "cameras.png", typed=True) as temporary:
        draw_cameras(temporary, moved, xyz, colors, f"{len(moved)} cameras, {len(xyz)} points")
    forget(work)
    return {**results, "stills": len(stills), "sequences": sequences, "sequences_without_poses": left_out}


def _write_sequences(
    work: Path, sources: Sources, material: Material, moved: list[Posed], straighteners: Straighteners, used: set[str],
    tick: Tick,
) -> tuple[dict[str, Any], dict[str, list[str]]]:  # fmt: skip
    """Writes the sequences whose cameras have poses; returns what is to be told of them, and what the others lack.

    ``used`` gets the keys of the images that are fixed cameras, and so no stills.
    """
    from data_prep.capture.cameras.output import key_of, write_sequence

    by_name = {key_of(shot.photo.name): shot for shot in moved}
    sequences, left_out = {}, {}
    for folder, names in material.sequences.items():
        cameras, missing = _cameras_of(folder, names, by_name, used)
        if missing:
            left_out[folder.name] = missing
            continue
        target = work / "sequences" / folder.name
        frames = write_sequence(target, {n: folder / n for n in cameras}, cameras, material.fps, straighteners, tick)
        sequences[folder.name] = {"cameras": list(cameras), "frames": frames}
    if material.sequences and not sequences:
        remedy = (
            "Their first frames must show the same scene as the stills, from places that stills were taken near."
            if sources.kind == "mapping"
            else "A fixed camera cam_0 of seq_000 is the image seq_000/cam_0 or cam_0 of what is taken over, which has "
            f"{', '.join(sorted(by_name)[:_NAMED])}."
        )
        raise DataError(
            f"{next(iter(material.sequences)).parent}: no sequence has poses of all its cameras (missing: {left_out}). "
            + remedy
        )
    return sequences, left_out


def _cameras_of(
    folder: Path, names: Sequence[str], by_name: dict[str, Posed], used: set[str]
) -> tuple[dict[str, Posed], list[str]]:
    from data_prep.capture.cameras.output import sequence_cameras

    cameras, missing = sequence_cameras(folder, by_name, names)
    used.update(k for name in cameras for k in (f"{folder.name}/{name}", name) if k in by_name)
    return cameras, missing


def _colors(found: list[Posed], points: PointTable, sources: Sources) -> np.ndarray:
    from data_prep.capture.cameras.report import point_colors

    return points.rgb if sources.kind == "colmap" else point_colors(found, points)


def _found(
    work: Path, sources: Sources, material: Material, mapping: MappingOptions, tick: Tick
) -> tuple[list[Posed], PointTable, dict[str, Any]]:
    """Poses in the world that they were found in, points, and what is to be told of them."""
    from data_prep.capture.cameras import sources as pose_sources
    from gausim.io.colmap import find_colmap, read_colmap

    points = pose_sources.no_points()
    if sources.kind == "mapping":
        return _map(work, material, mapping, tick)
    if sources.colmap is not None and sources.images is not None:
        model = read_colmap(find_colmap(sources.colmap))
        found = pose_sources.from_model(model, pose_sources.photos_of_model(model, sources.images))
        points = model.points
    elif sources.transforms is not None:
        found = pose_sources.read_lens_transforms(sources.transforms)
    else:
        assert sources.projections is not None and sources.images is not None
        found = pose_sources.read_projections(sources.projections, sources.images, sources.scale)
    return found, points, {"images": len(found), "registered": len(found), "failed": [], "cameras": _lenses(found)}


def _map(
    work: Path, material: Material, options: MappingOptions, tick: Tick
) -> tuple[list[Posed], PointTable, dict[str, Any]]:
    """Poses by structure from motion of the stills and the first frames of all videos."""
    from data_prep.capture.cameras.mapping import map_photos
    from data_prep.capture.cameras.report import failures
    from data_prep.capture.cameras.sources import from_model
    from data_prep.common.photos import list_images, open_photo
    from gausim.io.colmap import read_colmap

    photos, cameras = list(material.stills), {photo.name: "stills" for photo in material.stills}
    for folder, names in material.sequences.items():
        for name in names:
            first = list_images(folder / name)[0]
            photo = open_photo(first, f"{folder.name}/{name}{first.suffix}")
            photos.append(photo)
            cameras[photo.name] = name
    mapped = map_photos(photos, cameras, work, options, tick)
    model = read_colmap(mapped.folder)
    found = from_model(model, {photo.name: photo for photo in photos})
    results = {
        "images": len(photos),
        "registered": len(found),
        "failed": failures(photos, found, mapped.features, mapped.matches),
        "other_models": list(mapped.others),
        "cameras": _lenses(found),
    }
    return found, model.points, results


def _lenses(found: list[Posed]) -> list[dict[str, Any]]:
    """The different lenses with the number of their photos."""
    counts: dict[tuple, int] = {}
    for shot in found:
        camera = shot.camera
        key = (camera.model, camera.width, camera.height, tuple(camera.params.tolist()))
        counts[key] = counts.get(key, 0) + 1
    return [
        {"model": model, "width": width, "height": height, "params": list(params), "photos": count}
        for (model, width, height, params), count in counts.items()
    ]


def _world(
    found: list[Posed], points: PointTable, options: WorldOptions, *, mapped: bool
) -> tuple[Similarity, dict[str, Any]]:
    """The transform to the world that was asked for, and what is to be told of it."""
    from data_prep.capture.cameras.world_options import place

    return place(found, points, up=options.up, distances=options.distances, mapped=mapped)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    from data_prep.capture.cameras.mapping import MappingOptions
    from data_prep.common.progress import bars

    def run() -> str:
        sources, mapping = _picked(Sources, arguments), _picked(MappingOptions, arguments)
        world = WorldOptions(arguments.up, tuple((a, b, m) for a, b, m in arguments.distance))
        with bars() as tick:
            manifest = find_poses(
                arguments.out, sources, mapping=mapping, world=world, force=arguments.force, tick=tick
            )
        return _summary(arguments.out, manifest)

    return told(run)


def _picked(kind: type[T], arguments: argparse.Namespace) -> T:
    """An instance of a dataclass from the arguments that have its fields' names."""
    return kind(**{field.name: getattr(arguments, field.name) for field in fields(kind)})  # type: ignore[arg-type]


def _summary(out: Path, manifest: dict[str, Any]) -> str:
    """What the command prints."""
    results = manifest["results"]
    error, world = results["reprojection"], results["world"]
    lines = [
        headline(out, manifest),
        f"registered     {results['registered']} of {results['images']} images",
    ]
    for photo in results["failed"]:
        facts = f"{photo['features']} features, {photo['matches']} matches"
        lines.append(f"  without pose {photo['name']} ({facts}): {photo['remedy']}")
    if results.get("other_models"):
        lines.append(f"  apart        models of {results['other_models']} images; add photos between them")
    if error["mean"] is not None:
        observations = f"{error['observations']} observations"
        lines.append(f"reprojection   mean {error['mean']:.3f}, median {error['median']:.3f} pixels ({observations})")
        lines.append(f"points         {results['points']['count']}, seen by {results['points']['mean_track']:.2f} each")
    lines.append(f"world          up {world['up']}, {world['unit']}")
    for name, facts in results["sequences"].items():
        lines.append(f"sequence       {name}: {len(facts['cameras'])} cameras, {facts['frames']} frames")
    for name, missing in results["sequences_without_poses"].items():
        lines.append(f"left out       {name}: no pose of {', '.join(missing)}")
    return "\n".join([*lines, f"look at        {out / 'cameras.png'}"])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="gausim prepare poses", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_result(parser)
    group = parser.add_argument_group("what is posed")
    add = group.add_argument
    add("--images", type=Path, metavar="DIR", help="photos of the rest state")
    add("--sequences", type=Path, metavar="DIR", help="result of ingest, or folders SEQ/CAM of frames; cameras stand "
        "still through a sequence, and its first frame shows the rest state")  # fmt: skip
    add("--fps", type=float, metavar="RATE", help="frames per second of the sequences (default: what ingest says)")
    group = parser.add_argument_group("poses that are taken over (default: found from the photos)")
    add = group.add_argument
    add("--colmap", type=Path, metavar="DIR", help="COLMAP model, binary or text, for --images of any size")
    add(
        "--transforms", type=Path, metavar="FILE", help="transforms.json, also with OPENCV or OPENCV_FISHEYE distortion"
    )
    add("--projections", type=Path, metavar="DIR", help="3 x 4 matrices as text: NAME.txt or NAME_P.txt for NAME.jpg")
    add("--scale", type=float, default=1.0, help="size of the photos / size the matrices are for (%(default)s)")
    group = parser.add_argument_group("how poses are found")
    add = group.add_argument
    add(
        "--camera-model",
        default="SIMPLE_RADIAL",
        help="of COLMAP: SIMPLE_RADIAL, OPENCV, OPENCV_FISHEYE ... (%(default)s)",
    )
    add("--intrinsics", choices=("shared", "per-image"), default="shared",
        help="one lens for all photos of a camera, or per image where it zooms or refocuses (%(default)s)")  # fmt: skip
    add("--focal", type=float, metavar="PIXELS", help="focal length where it is known (default: EXIF, else a guess)")
    add("--matching", choices=("exhaustive", "sequential"), default="exhaustive",
        help="every pair, or each photo with the next ones (%(default)s)")  # fmt: skip
    add("--overlap", type=int, default=10, metavar="N", help="next photos in sequential matching (%(default)s)")
    add("--features", type=int, default=4096, metavar="N", help="at most so many per photo (%(default)s)")
    add("--feature-size", type=int, default=1600, metavar="PIXELS", help="longer side they are found at (%(default)s)")
    add("--thorough", action="store_true", help="for few photos from places far apart: finds more, takes far longer")
    add("--threads", type=int, default=1, metavar="N", help="more: faster, repeatable up to rounding (%(default)s)")
    group = parser.add_argument_group("the world")
    add = group.add_argument
    add("--up", metavar="RULE", help="turn z up: by the mean up of the 'cameras' (default for found poses), the "
        "'plane' of their centres, a vector X,Y,Z, or 'keep' (default for poses that are taken over)")  # fmt: skip
    add("--distance", nargs=3, action="append", default=[], metavar=("A", "B", "METRES"),
        help="known distance; A and B are ids of points.npz or PHOTO@X,Y+PHOTO@X,Y; repeatable")  # fmt: skip
    return parser


if __name__ == "__main__":
    sys.exit(main())
