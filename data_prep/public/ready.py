"""READY in the layout of its authors: ROOT/sparse/0 (COLMAP), images/, video_images/, meta.json.

Images of the name seq_XXXXX_cam_XXXXX in the COLMAP model are the fixed video cameras, the others are stills; frames
lie in video_images/seq_XXXXX_cam_XXXXX/. Alpha comes from masks of the same names, where there are any (--image-masks,
--video-masks); otherwise the result still has to be segmented. Point clouds become scene.ply and its masks: kernels
within --near of moving_part_points.ply are simulated, of clean_object_points.ply foreground, and those that
pin_mask.json lists are pinned. Pickles are never read. Films have 50 frames per second (--fps; the orchids' 29.97).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from msgspec import Struct

from data_prep.capture.cameras.sources import Posed, posed_image
from data_prep.common.colmap import ColmapImage, ColmapModel, colmap_files, find_colmap, read_colmap
from data_prep.common.command import option
from data_prep.common.photos import find_mask, list_images, open_photo
from data_prep.public.fields import REMEDY, read_record
from data_prep.public.scene import ImportOptions, Motion, Picture, PublicObject, View, flattened, pinhole
from data_prep.ready.marks import scene_files, write_scene
from gausim.core.errors import DataError
from gausim.io.files import natural, slashed
from gausim.io.plain_json import checked

_VIDEO = re.compile(r"(seq_[0-9]+)_(cam_[0-9]+)")
FPS, TRAIN_FRAMES = 50.0, 16
# METHOD of the paper's data: kernels this near to a point cloud belong to it [scene units].
NEAR = 0.01


@dataclass(frozen=True)
class Options(ImportOptions):
    """Facts that the folders do not contain."""

    near: float = option(NEAR, "distance to the point clouds [scene units] (%(default)s)", least=1e-9, most=1e6)
    image_masks: Path | None = option(None, "masks of stills, named like them (ROOT/masks)", metavar="DIR")
    video_masks: Path | None = option(None, "masks of frames, like video_images (ROOT/video_masks)", metavar="DIR")


class Lists(Struct):
    """Sequences of ``meta.json`` by name or number."""

    train: list[str | int] | None = None
    test: list[str | int] | None = None
    invalid: list[str | int] | None = None
    force_invalid: list[str | int] | None = None


@dataclass(frozen=True)
class Meta:
    """``meta.json``: lists of sequences by name, and pairs that share their cameras."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    invalid: tuple[str, ...]  # sequences that are not used
    twins: dict[str, str]


def read_meta(path: Path) -> Meta:
    """Reads ``meta.json``."""
    data, twins = read_record(path, dict), dict[str, str]()
    lists = checked(data, Lists, str(path), REMEDY)
    train, test, *invalid = (_names(path, row or []) for row in
                             (lists.train, lists.test, lists.invalid, lists.force_invalid))  # fmt: skip
    if set(train) & set(test):
        raise DataError(f"{path}: fields 'train' and 'test' share {sorted(set(train) & set(test))}.")
    for key in (k for k in data if "twin" in k.lower()):
        pairs = list(data[key].items()) if isinstance(data[key], dict) else data[key] or []
        for pair in checked(pairs, list[tuple[str | int, str | int]], f"{path}: field '{key}'", "Expected pairs."):
            a, b = _names(path, pair)
            twins |= {a: b, b: a}
    return Meta(train, test, (*invalid[0], *invalid[1]), twins)


def _names(path: Path, values: list[str | int] | tuple[str | int, ...]) -> tuple[str, ...]:
    """Names of sequences that are given by their numbers, as texts or numbers, or by their names."""
    names = []
    for value in values:
        if not re.fullmatch(r"(seq_)?[0-9]{1,9}", text := str(value)):
            raise DataError(f"{path}: expected sequences like 'seq_00001' or 1, got {value!r:.60}.")
        names.append(text if text.startswith("seq_") else f"seq_{int(text):05d}")
    return tuple(names)


def read(root: Path, options: Options) -> PublicObject:
    """One object."""
    model, meta = read_colmap(find_colmap(root)), read_meta(root / "meta.json")
    images = {Path(image.name).stem: image for image in model.images}
    used, left_out = _usable(root / "video_images", set(images), meta)
    common = set.intersection(*(set(cameras) for cameras in used.values()))
    if not common:
        raise DataError(f"{root / 'video_images'}: the sequences have no camera in common: {used}.")
    views = sorted(common, key=natural)
    image_masks, video_masks = options.image_masks or root / "masks", options.video_masks or root / "video_masks"
    for given in (options.image_masks, options.video_masks):
        if given is not None and not given.is_dir():
            raise DataError(f"{given}: no such folder. Expected masks, named like the images.")
    motions = []
    for name in used:
        twin = meta.twins.get(name, name)
        seen = {view: images.get(f"{name}_{view}") or images[f"{twin}_{view}"] for view in views}
        motions.append(_motion(root, name, seen, model, video_masks))
    stills = [_still(root, model, images[stem], image_masks) for stem in images if not _VIDEO.fullmatch(stem)]
    extra = {name: sorted(set(cameras) - common) for name, cameras in used.items()}
    notes = {f"{name} left out": why for name, why in left_out.items()}
    notes |= {f"{name} without": ", ".join(cameras) for name, cameras in extra.items() if cameras}
    facts = {f"{part}_sequences": [n for n in used if n in getattr(meta, part)] for part in ("train", "test")}
    return PublicObject(
        root, options.name or root.absolute().name, options.fps or FPS, options.train_frames or TRAIN_FRAMES,
        tuple(motions), options.heldout, facts, tuple(stills),
        partial(write_scene, root=root, near=options.near),
        {**{f"sparse/{role}": path for role, path in colmap_files(model.path).items()}, "meta.json": root / "meta.json",
         **scene_files(root)}, notes,
    )  # fmt: skip


def _usable(place: Path, posed: set[str], meta: Meta) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Cameras with frames and poses by sequence that meta.json does not call invalid; why the others are none."""
    videos: dict[str, list[str]] = {}
    for found in sorted(place.iterdir(), key=lambda p: natural(p.name)) if place.is_dir() else ():
        match = _VIDEO.fullmatch(found.name)
        if match and found.is_dir():
            videos.setdefault(match[1], []).append(match[2])
    used, left_out = {}, {}
    for name, cameras in videos.items():
        good = [c for c in cameras if posed & {f"{name}_{c}", f"{meta.twins.get(name, name)}_{c}"}]
        if name in meta.invalid:
            left_out[name] = "meta.json calls it invalid"
        elif not good:
            left_out[name] = "none of its cameras is in the COLMAP model"
        else:
            used[name] = good
    absent = "meta.json lists it, but video_images has no frames of it"
    left_out |= {name: absent for name in (*meta.train, *meta.test) if name not in videos}
    if not used:
        raise DataError(f"{place}: no usable sequence here ({left_out or 'no folders seq_XXXXX_cam_XXXXX'}).")
    return used, left_out


def _motion(root: Path, name: str, seen: dict[str, ColmapImage], model: ColmapModel, masks: Path) -> Motion:
    views, pictures = [], {}
    for view, image in seen.items():
        folder = f"{name}_{view}"
        frames = list_images(root / "video_images" / folder)
        shot = posed_image(open_photo(frames[0], f"{name}/{view}"), model, image)
        camera, straight = pinhole(view, shot)
        views.append(camera)
        names = [Path(folder, p.name) for p in frames]
        pictures[view] = tuple(
            flattened(root / "video_images" / name, straight, camera.size, _mask(masks, name)) for name in names
        )
    return Motion(name, root / "video_images", tuple(views), pictures)


def _still(root: Path, model: ColmapModel, image: ColmapImage, masks: Path) -> tuple[View, Picture]:
    name = slashed(root / "images", image.name)
    path = root / "images" / name
    shot: Posed = posed_image(open_photo(path, name), model, image)
    view, straight = pinhole(path.stem, shot)
    return view, flattened(path, straight, view.size, _mask(masks, Path(name)))


def _mask(folder: Path, name: Path) -> Path | None:
    return find_mask(folder, name) if folder.is_dir() else None
