"""PhysDreamer: real captures of stills, and films of a motion from the place of one of them.

ROOT is physics_dreamer/OBJECT: sparse/0 (COLMAP) or transforms_train.json, images/, point_cloud.ply,
moving_part_points.ply and clean_object_points.ply, and in videos/ films whose names begin with that of the still from
whose place they were made (or frames as PNG, with --cameras and --fps). Kernels near the moving cloud are simulated,
near the object's cloud foreground; those of the object that do not move but touch what moves (--anchor) are pinned.
Stills get alpha from masks/STILL_mask.png where there are such; frames need masks (--video-masks), or the result is to
be segmented next. A single view cannot tell depth: expect motion across it to be learned, not along it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from data_prep.capture.cameras.sources import Posed, fitted, from_model, read_lens_transforms
from data_prep.capture.films.film import FILMS, FilmFrames
from data_prep.common.colmap import colmap_files, find_colmap, read_colmap
from data_prep.common.command import option
from data_prep.common.photos import Photo, list_images, open_photo, read_picture
from data_prep.public.fields import check_name
from data_prep.public.scene import ImportOptions, Motion, PublicObject, flattened, pinhole
from data_prep.ready.marks import SCENE, scene_files, write_scene
from gausim.core.errors import ConfigError, DataError
from gausim.io.files import natural

BLENDER = "transforms_train.json"
# GausSim's paper trains on the first 16 frames.
TRAIN_FRAMES = 16


@dataclass(frozen=True)
class Options(ImportOptions):
    """Facts that the folder does not contain."""

    cameras: str | None = option(
        None, "take this still as the place of the film (default: the film's name begins with it)", metavar="NAME"
    )
    near: float = option(0.01, "distance to the point clouds [scene units] (%(default)s)", least=1e-9, most=1e6)
    anchor: float = option(
        0.05, "kernels of the object this near to what moves, but not moving, are pinned [scene units] (%(default)s)",
        least=1e-9, most=1e6,
    )  # fmt: skip
    video_masks: Path | None = option(None, "masks of the frames, 0000.png … (white is the object)", metavar="DIR")


def read(root: Path, options: Options) -> PublicObject:
    """One object."""
    if (root / BLENDER).is_file():
        shots, files = read_lens_transforms(root / BLENDER), {BLENDER: root / BLENDER}
    else:
        model = read_colmap(find_colmap(root))
        shots = from_model(model, root / "images")
        files = {f"sparse/{role}": path for role, path in colmap_files(model.path).items()}
    posed = {check_name(Path(shot.photo.name).stem, f"{root}: image '{shot.photo.name}'"): shot for shot in shots}
    parts = scene_files(root)
    if len(posed) < len(shots) or SCENE not in parts:
        raise DataError(
            f"{root}: expected photos with names of their own, and {SCENE} with the Gaussians. The set has them of "
            "every object: take it from there."
        )
    view, paths = _films(root / "videos", posed, options)
    found = [_motion(i, path, view, posed[view], options) for i, path in enumerate(paths)]
    motions, rates = tuple(motion for motion, _ in found), {rate for _, rate in found}
    if options.fps is None and (len(rates) > 1 or None in rates):
        raise ConfigError(f"--fps: {root / 'videos'} does not say one rate ({', '.join(map(str, rates))}); state it.")
    shortest = min(motion.count for motion in motions)
    stills = []
    for name, shot in posed.items():
        mask, (camera, straight) = root / "masks" / f"{name}_mask.png", pinhole(name, shot)
        path = shot.photo.path
        stills.append((camera, flattened(path, straight, camera.size, mask if mask.is_file() else None)))
    return PublicObject(
        root, options.name or root.absolute().name, options.fps or rates.pop() or 0.0,
        options.train_frames or min(TRAIN_FRAMES, shortest), motions, options.heldout, stills=tuple(stills),
        scene=partial(write_scene, root=root, near=options.near, anchor=options.anchor), files={**files, **parts},
    )  # fmt: skip


def _films(folder: Path, posed: Mapping[str, Posed], options: Options) -> tuple[str, list[Path]]:
    """The still from whose place was filmed, and the films."""
    if options.cameras is not None and options.cameras not in posed:
        raise ConfigError(f"--cameras {options.cameras}: no such still; there are {sorted(posed, key=natural)[:12]}.")
    found = [p for p in folder.iterdir() if p.suffix.lower() in FILMS] if folder.is_dir() else []
    if folder.is_dir() and not found and options.cameras is not None:
        return options.cameras, [folder]  # of frames
    # The longest name wins: frame_1 is also the beginning of frame_11.
    of = {film: max((s for s in posed if film.stem.startswith(s)), key=len, default=options.cameras) for film in found}
    views = {view for view in of.values() if view is not None}
    view = options.cameras or (views.pop() if len(views) == 1 else None)
    chosen = sorted((film for film in found if of[film] == view), key=lambda p: natural(p.name))
    if view is None or not chosen:
        raise ConfigError(
            f"--cameras: {folder} holds films {[f.name for f in found][:6]} of the stills "
            f"{sorted(map(str, of.values()))[:6]}; expected a film, and the still from whose place it was made."
        )
    return view, chosen


def _motion(number: int, path: Path, name: str, shot: Posed, options: Options) -> tuple[Motion, float | None]:
    """A film, or a folder of frames, as a sequence of the camera that stood where a still was taken; its rate."""
    rate: float | None = None
    if path.is_dir():
        paths = list_images(path)
        photo, reads = open_photo(paths[0], name), [partial(read_picture, p) for p in paths]
        names = [f"{p.stem}.png" for p in paths]
    else:
        film = FilmFrames(path)
        photo, rate = Photo(path.name, path, *film.facts.size, None), float(film.facts.rate)
        paths, reads = [path] * len(film.facts), [partial(film.rgba, i) for i in range(len(film.facts))]
        names = [f"{i:04d}.png" for i in range(len(film.facts))]
    view, straight = pinhole(name, replace(shot, photo=photo, camera=fitted(shot.camera, photo)[1]))
    masks = [options.video_masks / n if options.video_masks is not None else None for n in names]
    frames = [flattened(p, straight, view.size, m, r) for p, m, r in zip(paths, masks, reads, strict=True)]
    return Motion(f"seq_{number:03d}", path, (view,), {name: tuple(frames)}), rate
