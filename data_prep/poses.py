"""Find the poses of photos and of fixed video cameras with COLMAP, or take them over.

The result is OUT/transforms.json with undistorted images/*.png (camera to world, OpenGL axes), points.npz (points,
colours, errors) and cameras.png to look at, and for videos sequences/SEQ/transforms.json with the undistorted frames.
Matching takes most of the time; interrupted, it goes on where it was.
"""

from __future__ import annotations

import argparse
import shutil
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from data_prep.capture.cameras.mapping import SCRATCH, MappingOptions, map_photos
from data_prep.capture.cameras.output import PosedWriter, key_of, sequence_cameras, write_points
from data_prep.capture.cameras.report import draw_cameras, point_colors, reprojection
from data_prep.capture.cameras.sources import Material, Posed, Sources, from_model
from data_prep.capture.cameras.world import WorldOptions, place
from data_prep.common.colmap import PointTable, read_colmap
from data_prep.common.command import add_options, chosen, headline, run_command, stage_parser
from data_prep.common.photos import list_images, open_photo
from data_prep.common.progress import Tick, silent
from data_prep.common.stage import Stage, run_stage
from gausim.core.errors import DataError
from gausim.io.files import replacing

# Raise when the same inputs and settings give another result than before.
REVISION = 1
PACKAGES = ("pycolmap", "numpy", "opencv-python-headless", "pillow")
# So many images are named where a camera is not among them.
_NAMED = 6


def find_poses(
    out: Path, sources: Sources, *, mapping: MappingOptions, world: WorldOptions | None = None, overwrite: bool = False,
    tick: Tick = silent,
) -> dict[str, Any]:  # fmt: skip
    """Runs the stage."""
    world = world or WorldOptions()
    material = Material.of(sources)
    settings: dict[str, Any] = {"source": sources.kind, "fps": material.fps, "world": asdict(world)}
    if sources.kind == "mapping":
        settings["mapping"] = {k: v for k, v in asdict(mapping).items() if k != "threads"}
    stage = Stage("poses", REVISION, material.inputs, settings, PACKAGES)
    return run_stage(stage, out, lambda work: _make(work, material, mapping, world, tick), overwrite=overwrite)


def _make(work: Path, material: Material, mapping: MappingOptions, world: WorldOptions, tick: Tick) -> dict[str, Any]:
    """Does the stage's work in ``work``."""
    if material.posed is None:
        found, points, results = _map(work, material, mapping, tick)
    else:
        found, points = material.posed
        without = list(material.without_pose)
        results = {"images": len(found) + len(without), "registered": len(found), "without_pose": without}
    results["cameras"], results["note"] = _lenses(found), material.note
    move, results["world"] = place(found, world, mapped=material.posed is None)
    results["reprojection"] = reprojection(points)
    moved = [replace(shot, viewmat=move.viewmat(shot.viewmat)) for shot in found]
    tracks = points.tracks
    results["points"] = {"count": len(tracks), "mean_track": float(tracks.mean()) if len(tracks) else None}
    writer, used = PosedWriter(tick), set[str]()
    sequences, left_out = _write_sequences(work, material, moved, writer, used)
    stills = [shot for shot in moved if key_of(shot.photo.name) not in used] or moved
    writer.stills(work, stills)
    xyz = move.points(points.xyz)
    colors = point_colors(found, points) if material.posed is None else points.rgb
    write_points(work / "points.npz", points, xyz, colors)
    with replacing(work / "cameras.png", typed=True) as temporary:
        draw_cameras(temporary, moved, xyz, colors, f"{len(moved)} cameras, {len(xyz)} points")
    shutil.rmtree(work / SCRATCH, ignore_errors=True)
    return {**results, "stills": len(stills), "sequences": sequences, "sequences_without_poses": left_out}


def _write_sequences(
    work: Path, material: Material, moved: list[Posed], writer: PosedWriter, used: set[str]
) -> tuple[dict[str, Any], dict[str, list[str]]]:
    """Writes the sequences whose cameras have poses; returns what is to be told of them, and what the others lack.

    ``used`` gets the keys of the images that are fixed cameras, and so no stills.
    """
    by_name = {key_of(shot.photo.name): shot for shot in moved}
    sequences, left_out = {}, {}
    for folder, names in material.sequences.items():
        cameras, missing = sequence_cameras(folder, by_name, names)
        used.update(k for name in cameras for k in (f"{folder.name}/{name}", name) if k in by_name)
        if missing:
            left_out[folder.name] = missing
            continue
        folders = {name: folder / name for name in cameras}
        frames = writer.sequence(work / "sequences" / folder.name, folders, cameras, material.fps)
        sequences[folder.name] = {"cameras": list(cameras), "frames": frames}
    if material.sequences and not sequences:
        remedy = (
            "Their first frames must show the same scene as the stills, from places that stills were taken near."
            if material.posed is None
            else "A fixed camera cam_0 of seq_000 is the image seq_000/cam_0 or cam_0 of what is taken over, which has "
            f"{', '.join(sorted(by_name)[:_NAMED])}."
        )
        raise DataError(
            f"{next(iter(material.sequences)).parent}: no sequence has poses of all its cameras (missing: {left_out}). "
            + remedy
        )
    return sequences, left_out


def _map(
    work: Path, material: Material, options: MappingOptions, tick: Tick
) -> tuple[list[Posed], PointTable, dict[str, Any]]:
    """Poses by structure from motion of the stills and the first frames of all videos."""
    photos, cameras = list(material.stills), {photo.name: "stills" for photo in material.stills}
    for folder, names in material.sequences.items():
        for name in names:
            first = list_images(folder / name)[0]
            photo = open_photo(first, f"{folder.name}/{name}{first.suffix}")
            photos.append(photo)
            cameras[photo.name] = name
    try:
        folder, others = map_photos(photos, cameras, work, options, tick)
    except DataError as error:
        raise DataError(f"{error} {material.note}".strip()) from error
    model = read_colmap(folder)
    found = from_model(model, {photo.name: photo for photo in photos})
    without = sorted({photo.name for photo in photos} - {shot.photo.name for shot in found})
    results = {"images": len(photos), "registered": len(found), "without_pose": without, "other_models": others}
    return found, model.points, results


def _lenses(found: list[Posed]) -> list[dict[str, Any]]:
    """The different lenses with the number of their photos."""
    counts = Counter((c.model, c.width, c.height, tuple(c.params.tolist())) for c in (shot.camera for shot in found))
    return [
        {"model": model, "width": width, "height": height, "params": list(params), "photos": photos}
        for (model, width, height, params), photos in counts.items()
    ]


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("poses", __doc__)
    add_options(parser.add_argument_group("what is posed, and poses that are taken over (default: found)"), Sources)
    add_options(parser.add_argument_group("how poses are found"), MappingOptions)
    add_options(parser.add_argument_group("the world"), WorldOptions)

    def run(arguments: argparse.Namespace, tick: Tick) -> str:
        manifest = find_poses(
            arguments.out, chosen(Sources, arguments), mapping=chosen(MappingOptions, arguments),
            world=chosen(WorldOptions, arguments), overwrite=arguments.overwrite, tick=tick,
        )  # fmt: skip
        return _summary(arguments.out, manifest)

    return run_command(parser, argv, run)


def _summary(out: Path, manifest: dict[str, Any]) -> str:
    """Text that the command prints."""
    results = manifest["results"]
    error, world = results["reprojection"], results["world"]
    lines = [headline(out, manifest), f"registered     {results['registered']} of {results['images']} images"]
    if results.get("without_pose"):
        names = ", ".join(results["without_pose"][:_NAMED])
        lines.append(
            f"without pose   {len(results['without_pose'])} photos (blurred, plain, or too far apart): {names}"
        )
    if results["note"]:
        lines.append(f"note           {results['note']}")
    if results.get("other_models"):
        lines.append(f"  apart        models of {results['other_models']} images; add photos between them")
    if error["mean"] is not None:
        observations = f"{error['observations']} observations"
        lines.append(f"reprojection   mean {error['mean']:.3f} pixels ({observations})")
        lines.append(f"points         {results['points']['count']}, seen by {results['points']['mean_track']:.2f} each")
    lines.append(f"world          up {world['up']}, {world['unit']}")
    for name, facts in results["sequences"].items():
        lines.append(f"sequence       {name}: {len(facts['cameras'])} cameras, {facts['frames']} frames")
    for name, missing in results["sequences_without_poses"].items():
        lines.append(f"left out       {name}: no pose of {', '.join(missing)}")
    return "\n".join([*lines, f"look at        {out / 'cameras.png'}"])
