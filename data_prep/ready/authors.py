"""The layout of READY's authors: which files there are, which sequences count, whose cameras they have, what is marked.

PhysDreamer's folders have the same scene: a point cloud of Gaussians, clouds and a list that mark parts of it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.capture.cameras.sources import Posed, fitted
from data_prep.common.photos import list_images, open_photo
from gausim.core.errors import DataError, SceneError
from gausim.io.colmap import ColmapImage, ColmapModel, colmap_files, find_colmap, read_colmap
from gausim.io.files import natural
from gausim.io.plain_json import checked, read_any_json, read_json

_VIDEO = re.compile(r"(seq_[0-9]+)_(cam_[0-9]+)")
# Lists of meta.json; sequences of the last two are not used.
_LISTS = ("train", "test", "invalid", "force_invalid")
SCENE, MOVING, OBJECT, PINS = "point_cloud.ply", "moving_part_points.ply", "clean_object_points.ply", "pin_mask.json"


@dataclass(frozen=True)
class Meta:
    """``meta.json``: lists of sequences by name, and pairs that share their cameras."""

    lists: dict[str, tuple[str, ...]]
    twins: dict[str, str]


def read_meta(path: Path) -> Meta:
    """Reads ``meta.json``.

    Raises:
        DataError: it is missing or malformed.
    """
    data, twins = read_json(path), dict[str, str]()
    lists = {key: _sequences(path, key, data.get(key) or []) for key in _LISTS}
    both = set(lists["train"]) & set(lists["test"])
    if both:
        raise DataError(f"{path}: fields 'train' and 'test' share {sorted(both)}.")
    for key in (k for k in data if "twin" in k.lower()):
        pairs = list(data[key].items()) if isinstance(data[key], dict) else data[key] or []
        for pair in checked(pairs, list[tuple[str | int, str | int]], f"{path}: field '{key}'", "Expected pairs."):
            a, b = _sequences(path, key, list(pair))
            twins |= {a: b, b: a}
    return Meta(lists, twins)


def _sequences(path: Path, key: str, values: Any) -> tuple[str, ...]:
    """Names of sequences that are given by their numbers, as texts or numbers, or by their names."""
    names = []
    for value in checked(values, list[str | int], f"{path}: field '{key}'", "Expected a list of sequences."):
        if not re.fullmatch(r"(seq_)?[0-9]{1,9}", text := str(value)):
            raise DataError(f"{path}: field '{key}': expected sequences like 'seq_00001' or 1, got {value!r:.60}.")
        names.append(text if text.startswith("seq_") else f"seq_{int(text):05d}")
    return tuple(names)


@dataclass(frozen=True, eq=False)
class ReadyFiles:
    """One object in the authors' layout."""

    root: Path  # its folder
    model: ColmapModel  # the COLMAP model
    meta: Meta  # ``meta.json``
    stills: tuple[Posed, ...]  # the images that are no video cameras
    frames: dict[str, dict[str, Path]]  # per sequence that is used, in their order, per view the folder of its frames
    views: tuple[str, ...]  # cameras that all sequences have
    extra_views: dict[str, list[str]]  # per sequence, cameras that not all others have
    left_out: dict[str, str]  # sequences that are not used, and why
    masks: dict[str, Path | None]  # folders of masks, of ``images`` and of ``video_images``, where there are some

    def mask(self, path: Path) -> Path | None:
        """The mask of a still or a frame: the same path with the ending of any image, or with ``.png`` appended.

        Raises:
            DataError: the others have masks, this has none.
        """
        kind, *parts = path.relative_to(self.root).parts
        folder, name = self.masks[kind], Path(*parts)
        if folder is None:
            return None
        for candidate in (folder / name.with_suffix(".png"), folder / name, folder / f"{name}.png"):
            if candidate.is_file():
                return candidate
        raise DataError(f"{folder / name.with_suffix('.png')}: no mask of {name}. Restore it, or leave out the folder.")

    def inputs(self) -> dict[str, Path]:
        """Everything that is read, by name."""
        model = {f"sparse/{role}": path for role, path in colmap_files(self.model.path).items()}
        files = {**model, "meta.json": self.root / "meta.json", **scene_files(self.root)}
        folders = [folder for cameras in self.frames.values() for folder in cameras.values()]
        images = [shot.photo.path for shot in self.stills]
        for path in chain(images, *map(list_images, folders)):
            name = str(path.relative_to(self.root))
            files[name] = path
            if (mask := self.mask(path)) is not None:
                files[f"mask of {name}"] = mask
        return files


def find_files(root: Path, image_masks: Path | None = None, video_masks: Path | None = None) -> ReadyFiles:
    """Looks through a folder in the authors' layout; decodes no image.

    Raises:
        DataError: the model or ``meta.json`` is missing or malformed, an image is missing, or no sequence is usable.
    """
    model, meta = read_colmap(find_colmap(root)), read_meta(root / "meta.json")
    videos: dict[str, dict[str, Path]] = {}
    place = root / "video_images"
    for found in sorted(place.iterdir(), key=lambda p: natural(p.name)) if place.is_dir() else ():
        match = _VIDEO.fullmatch(found.name)
        if match and found.is_dir():
            videos.setdefault(match[1], {})[match[2]] = found
    used, left_out = _usable(videos, {Path(image.name).stem for image in model.images}, meta)
    if not used:
        raise DataError(f"{place}: no usable sequence here ({left_out or 'no folders seq_XXXXX_cam_XXXXX'}).")
    common = set.intersection(*(set(cameras) for cameras in used.values()))
    if not common:
        raise DataError(f"{place}: the sequences have no camera in common: { {n: list(c) for n, c in used.items()} }.")
    views = tuple(sorted(common, key=natural))
    stills = (image for image in model.images if not _VIDEO.fullmatch(Path(image.name).stem))
    return ReadyFiles(
        root, model, meta,
        tuple(_posed(root / "images" / image.name, image.name, model, image) for image in stills),
        {name: {view: cameras[view] for view in views} for name, cameras in used.items()},
        views, {name: sorted(set(cameras) - common) for name, cameras in used.items()}, left_out,
        {"images": _folder(image_masks, root / "masks"), "video_images": _folder(video_masks, root / "video_masks")},
    )  # fmt: skip


def _folder(given: Path | None, usual: Path) -> Path | None:
    if given is not None and not given.is_dir():
        raise DataError(f"{given}: no such folder. Expected masks, named like the images.")
    return given or (usual if usual.is_dir() else None)


def _usable(
    videos: dict[str, dict[str, Path]], posed: set[str], meta: Meta
) -> tuple[dict[str, dict[str, Path]], dict[str, str]]:
    """Sequences with frames and poses that meta.json does not call invalid, and why the others are none."""
    used, left_out = {}, {}
    invalid = {*meta.lists["invalid"], *meta.lists["force_invalid"]}
    for name, cameras in videos.items():
        twin = meta.twins.get(name, name)
        good = {c: p for c, p in cameras.items() if posed & {f"{name}_{c}", f"{twin}_{c}"}}
        if name in invalid:
            left_out[name] = "meta.json calls it invalid"
        elif not good:
            left_out[name] = "none of its cameras is in the COLMAP model"
        else:
            used[name] = good
    for name in (*meta.lists["train"], *meta.lists["test"]):
        if name not in videos:
            left_out[name] = "meta.json lists it, but video_images has no frames of it"
    return used, left_out


def _posed(path: Path, name: str, model: ColmapModel, image: ColmapImage) -> Posed:
    photo = open_photo(path, name)
    return Posed(photo, fitted(model.cameras[image.camera], photo), image.viewmat, image.xy, image.point_ids)


def sequence_poses(files: ReadyFiles, name: str) -> dict[str, Posed]:
    """The cameras of a sequence, its own or its twin's, for the size of its frames.

    Raises:
        DataError: a folder of frames is empty or has another shape than its camera.
    """
    images = {Path(image.name).stem: image for image in files.model.images}
    twin = files.meta.twins.get(name, name)
    return {
        view: _posed(
            list_images(folder)[0], f"{name}/{view}", files.model,
            images.get(f"{name}_{view}") or images[f"{twin}_{view}"],
        )
        for view, folder in files.frames[name].items()
    }  # fmt: skip


def read_pins(path: Path, count: int) -> np.ndarray:
    """(count,) bool of ``pin_mask.json``: a list of kernel numbers, or of one truth value per kernel.

    The list may stand alone or as the only list of an object.

    Raises:
        DataError: it is anything else, or a number is no kernel's.
    """
    data = read_any_json(path)
    if isinstance(data, dict):
        lists = [value for value in data.values() if isinstance(value, list)]
        data = lists[0] if len(lists) == 1 else None
    if not isinstance(data, list) or not data:
        raise DataError(f"{path}: expected a list of kernel numbers.")
    if all(isinstance(v, bool) for v in data) and len(data) == count:
        return np.array(data)
    wrong = [v for v in data if isinstance(v, bool) or not isinstance(v, int) or not 0 <= v < count]
    if wrong:
        raise DataError(f"{path}: '{wrong[0]!r:.40}' is no kernel; expected whole numbers from 0 to {count - 1}.")
    pins = np.zeros(count, bool)
    pins[data] = True
    return pins


def scene_files(root: Path) -> dict[str, Path]:
    """The files of the scene that are there, by name."""
    return {name: root / name for name in (SCENE, MOVING, OBJECT, PINS) if (root / name).is_file()}


def write_scene(work: Path, root: Path, near: float, *, anchor: float | None = None) -> dict[str, int] | None:
    """Writes ``scene.ply`` with its masks, where there is a point cloud, and returns how many kernels they mark.

    Args:
        work: the folder to write to.
        root: the folder with the clouds.
        near: kernels so close to the moving cloud are simulated, to the object's cloud foreground [scene units].
        anchor: kernels of the object that do not move, but are so close to what moves, are simulated and pinned
            [scene units]; None: the pins are those of the list.

    Raises:
        SceneError: the point cloud is no 3DGS scene, or a mask marks nothing.
        DataError: a cloud or the list is malformed.
    """
    import torch

    from data_prep.ready.selections import read_points
    from gausim.io.ply import load_scene, save_scene
    from gausim.ops.selection import NearPoints, apply_masks

    files = scene_files(root)
    if SCENE not in files:
        return None
    scene = load_scene(files[SCENE], name="scene")
    masks: dict[str, Any] = {}
    for mask, cloud in (("simulated", MOVING), ("foreground", OBJECT)):
        if cloud in files:
            masks[mask] = NearPoints(torch.from_numpy(read_points(files[cloud])), near)(scene)
    if anchor is not None and "simulated" in masks and masks["simulated"].any():
        moving = NearPoints(scene.means[masks["simulated"]], anchor)(scene)
        masks["pinned"] = moving & masks.get("foreground", torch.ones_like(moving)) & ~masks["simulated"]
        if not masks["pinned"].any():
            raise SceneError(
                f"{files[MOVING]}: no kernel of the object is within {anchor:g} of the moving ones without being one. "
                "Give a larger --anchor, or mark the pins with `select`."
            )
        masks["simulated"] = masks["simulated"] | masks["pinned"]
    elif PINS in files:
        masks["pinned"] = torch.from_numpy(read_pins(files[PINS], scene.count))
    scene = apply_masks(scene, **masks)
    save_scene(scene, work / "scene.ply")
    return {"kernels": scene.count} | {n: int(getattr(scene, n).sum()) for n in ("simulated", "pinned", "foreground")}
