"""Brings an object of PhysDreamer's real captures to our layout: stills, and one view of a motion.

ROOT has sparse/0 (COLMAP) or transforms_train.json, images/, point_cloud.ply, moving_part_points.ply and
clean_object_points.ply, and in videos/ a film whose name begins with that of the still from whose place it was made (or
frames as PNG, with --view and --fps). Kernels near the moving cloud are simulated, near the object's cloud foreground;
those of the object that do not move but touch what moves (--anchor) are pinned. Stills get alpha from
masks/STILL_mask.png where there are such; frames need masks (--video-masks), or the result is to be segmented next. A
single view cannot tell depth: expect motion across it to be learned, not along it.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

from data_prep.capture.cameras.output import PosedWriter
from data_prep.capture.cameras.sources import Posed, fitted, from_model, photos_of_model, read_lens_transforms
from data_prep.capture.films.film import probe
from data_prep.capture.masks.clips import film_frames
from data_prep.common.command import Options, add_options, chosen, headline, option, run_command, stage_parser
from data_prep.common.objects import described, object_facts, refuse_faults, train_command
from data_prep.common.photos import list_images, natural, open_photo
from data_prep.common.progress import Tick, silent
from data_prep.common.stage import Stage, files_in, run_stage
from data_prep.public.fields import check_name
from data_prep.public.importing import rate_option
from data_prep.ready.authors import SCENE, scene_files, write_scene
from gausim.core.errors import ConfigError, DataError
from gausim.io.colmap import colmap_files, find_colmap, read_colmap
from gausim.io.files import write_json

# Raise when the same inputs and settings give another result than before.
REVISION = 1
STAGE = "import_physdreamer"
BLENDER, VIDEOS, FRAMES = "transforms_train.json", "videos", ".frames"
FILMS = (".mp4", ".mov", ".avi", ".mkv")
# GausSim's paper trains on the first 16 frames.
TRAIN_FRAMES = 16


@dataclass(frozen=True)
class PhysDreamerOptions(Options):
    """Facts that the folder does not contain."""

    name: str | None = option(None, "of the object (the folder's)")
    train_frames: int | None = option(
        None, f"first frames to train on ({TRAIN_FRAMES}, or all of fewer)", least=2, metavar="N"
    )
    view: str | None = option(None, "still from whose place the motion was filmed (the film's name begins with it)")
    fps: float | None = rate_option("the film's; has to be stated of PNG frames")
    near: float = option(0.01, "distance to the point clouds [scene units] (%(default)s)", least=1e-9, most=1e6)
    anchor: float = option(
        0.05, "kernels of the object this near to what moves, but not moving, are pinned [scene units] (%(default)s)",
        least=1e-9, most=1e6,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Capture:
    """What a folder holds."""

    root: Path
    posed: Mapping[str, Posed]  # every still, by the stem of its name
    view: str  # the still from whose place was filmed
    films: tuple[Path, ...]  # one per sequence, or one folder of frames
    files: Mapping[str, Path]  # what is read besides pictures

    def still_mask(self, photo: Path) -> Path | None:
        """The mask of a still, where there is one."""
        path = self.root / "masks" / f"{photo.stem}_mask.png"
        return path if path.is_file() else None

    def pictures(self) -> list[Path]:
        """Photos, their masks and films."""
        photos = [shot.photo.path for shot in self.posed.values()]
        masks = [mask for mask in map(self.still_mask, photos) if mask is not None]
        frames = [list_images(film) if film.is_dir() else [film] for film in self.films]
        return [*photos, *masks, *chain(*frames)]


def import_physdreamer(
    root: Path, out: Path, options: PhysDreamerOptions, *, video_masks: Path | None = None, force: bool = False,
    tick: Tick = silent,
) -> dict[str, Any]:  # fmt: skip
    """Runs the stage.

    Raises:
        DataError: a file is missing or malformed, or the result would have faults.
        SceneError: the point cloud is no 3DGS scene, or a mask marks nothing.
        ConfigError: an option does not suit the folder.
    """
    found = read_capture(root, options)
    if video_masks is not None and not video_masks.is_dir():
        raise ConfigError(
            f"--video-masks {video_masks}: no such folder. Expected masks named like the frames, 0000.png …"
        )
    inputs = {**found.files, **{path.relative_to(root).as_posix(): path for path in found.pictures()}}
    inputs |= {f"mask {path.name}": path for path in (list_images(video_masks) if video_masks is not None else ())}
    stage = Stage(STAGE, REVISION, inputs, asdict(options), ("av", "numpy", "opencv-python-headless", "pycolmap"))
    return run_stage(stage, out, lambda work: _make(work, out, found, options, video_masks, tick), force=force)


def read_capture(root: Path, options: PhysDreamerOptions) -> _Capture:
    """Looks through a folder; decodes no picture.

    Raises:
        DataError: poses, photos, a film or the scene are missing or malformed.
        ConfigError: no still, or more than one, was the film's place.
    """
    if (root / BLENDER).is_file():
        shots, poses = read_lens_transforms(root / BLENDER), {BLENDER: root / BLENDER}
    else:
        model = read_colmap(find_colmap(root))
        shots = from_model(model, photos_of_model(model, root / "images"))
        poses = {f"sparse/{role}": path for role, path in colmap_files(model.path).items()}
    posed = {check_name(Path(shot.photo.name).stem, f"{root}: image '{shot.photo.name}'"): shot for shot in shots}
    if len(posed) < len(shots):
        raise DataError(
            f"{root / 'images'}: two photos have the same name without ending. Rename one in the poses too."
        )
    parts = scene_files(root)
    if SCENE not in parts:
        raise DataError(f"{root / SCENE}: no such file. The set has the Gaussians of every object: take it from there.")
    view, films = _films(root / VIDEOS, posed, options)
    return _Capture(root, posed, view, films, {**poses, **parts})


def _films(folder: Path, posed: Mapping[str, Posed], options: PhysDreamerOptions) -> tuple[str, tuple[Path, ...]]:
    """The still from whose place was filmed, and the films."""
    if options.view is not None and options.view not in posed:
        raise ConfigError(f"--view {options.view}: no still of this name; there are {sorted(posed, key=natural)[:12]}.")
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder. Expected the film of the motion, named after a still.")
    films = sorted((p for p in folder.iterdir() if p.suffix.lower() in FILMS), key=lambda p: natural(p.name))
    if not films:
        list_images(folder)
        if options.view is None or options.fps is None:
            raise ConfigError(
                f"--view and --fps: {folder} has frames and no film; state the still and the frames per second."
            )
        return options.view, (folder,)
    # The longest name wins: frame_1 is also the beginning of frame_11.
    of = {film: max((s for s in posed if film.stem.startswith(s)), key=len, default=options.view) for film in films}
    views = {view for view in of.values() if view is not None}
    view = options.view or (views.pop() if len(views) == 1 else None)
    chosen_films = tuple(film for film in films if of[film] == view)
    if view is None or not chosen_films:
        raise ConfigError(
            f"--view: the films {[f.name for f in films][:6]} in {folder} belong to the stills "
            f"{sorted(map(str, of.values()))[:6]}; state the still from whose place the motion was filmed."
        )
    return view, chosen_films


def _make(
    work: Path, out: Path, found: _Capture, options: PhysDreamerOptions, masks: Path | None, tick: Tick
) -> dict[str, Any]:
    stills, place = {shot.photo.path for shot in found.posed.values()}, found.posed[found.view]

    def mask_of(path: Path) -> Path | None:
        if path in stills:
            return found.still_mask(path)
        mask = masks / f"{path.stem}.png" if masks is not None else None
        if mask is not None and not mask.is_file():
            raise DataError(f"{mask}: no mask of the frame {path.name}. Restore it, or leave --video-masks out.")
        return mask

    writer = PosedWriter(tick, mask_of)
    writer.stills(work / "static", list(found.posed.values()))
    frames, rates = {}, set[float]()
    for number, film in enumerate(found.films):
        name = f"seq_{number:03d}"
        folder, rate = _frames(film, work / FRAMES / name, options)
        rates.add(rate)
        first = open_photo(list_images(folder)[0], found.view)
        camera = replace(place, photo=first, camera=fitted(place.camera, first))
        frames[name] = writer.sequence(work / "sequences" / name, {found.view: folder}, {found.view: camera}, rate)
    shutil.rmtree(work / FRAMES, ignore_errors=True)
    if len(rates) > 1:
        raise DataError(
            f"{found.root / VIDEOS}: films have different rates {sorted(rates)}. State --fps, or take one out."
        )
    facts = _facts(found, options, rates.pop(), min(frames.values()))
    scene = write_scene(work, found.root, options.near, anchor=options.anchor)
    write_json(work / "dataset.json", facts)
    if not writer.bare:
        refuse_faults(work, out)
    return {
        "facts": facts,
        "stills": len(found.posed),
        "sequences": frames,
        "scene": scene,
        "without_alpha": sorted(writer.bare),
        "files": files_in(work),
    }


def _frames(film: Path, folder: Path, options: PhysDreamerOptions) -> tuple[Path, float]:
    """The folder of a film's frames, and their rate."""
    if film.is_dir():
        assert options.fps is not None
        return film, options.fps
    rate = float(probe(film).rate)
    film_frames(film, folder)
    return folder, options.fps or rate


def _facts(found: _Capture, options: PhysDreamerOptions, fps: float, shortest: int) -> dict[str, Any]:
    trained = options.train_frames or min(TRAIN_FRAMES, shortest)
    if not 2 <= trained <= shortest:
        raise DataError(
            f"{found.root / VIDEOS}: a film has {shortest} frames, fewer than the {max(2, trained)} to train on."
        )
    return object_facts(options.name or found.root.absolute().name, fps, [found.view], (), trained)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser(STAGE, __doc__)
    parser.add_argument("root", type=Path, metavar="ROOT", help="folder of one object, physics_dreamer/OBJECT")
    parser.add_argument(
        "--video-masks", type=Path, metavar="DIR", help="masks of the frames, 0000.png … (white is the object)"
    )
    add_options(parser.add_argument_group("what the set does not say, or may say otherwise"), PhysDreamerOptions)

    def run(given: argparse.Namespace, tick: Tick) -> str:
        options = chosen(PhysDreamerOptions, given)
        manifest = import_physdreamer(
            given.root, given.out, options, video_masks=given.video_masks, force=given.force, tick=tick
        )
        return f"{headline(given.out, manifest)}\n{summary(manifest['results'], given.out)}"

    return run_command(parser, argv, run)


def summary(results: Mapping[str, Any], out: Path) -> str:
    """A few lines about what was imported, for people."""
    facts = results["facts"]
    lines = [*described(facts, results["stills"], results["sequences"]), f"scene       {results['scene']}"]
    if results["without_alpha"]:
        lines.append(f"no alpha    in {', '.join(results['without_alpha'])}: segment {out} next")
    else:
        lines.append(f"next        {train_command(facts['name'], out)}")
    return "\n".join(lines)
