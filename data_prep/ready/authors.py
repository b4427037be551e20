"""The layout of READY's authors: which files there are, which sequences count, whose cameras they have."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.capture.cameras.sources import Posed, fitted
from data_prep.common.photos import Photo, list_images, natural, open_photo
from gausim.core.errors import DataError
from gausim.io.colmap import ColmapImage, ColmapModel, colmap_files, find_colmap, read_colmap
from gausim.io.plain_json import parse_json
from gausim.io.transforms import read_json

_VIDEO = re.compile(r"(seq_[0-9]+)_(cam_[0-9]+)")
# Lists of meta.json; sequences of the last two are not used.
_LISTS = ("train", "test", "invalid", "force_invalid")


@dataclass(frozen=True, eq=False)
class ReadyFiles:
    """One object in the authors' layout.

    Attributes:
        root: its folder.
        model: the COLMAP model.
        stills: the images that are no video cameras.
        sequences: names of those that are used, in their order.
        views: cameras that all of them have.
        frames: per sequence, per view the folder of its frames.
        extra_views: per sequence, cameras that not all others have.
        left_out: sequences that are not used, and why.
        train: sequences that meta.json trains on.
        test: sequences that it tests on.
        twins: per sequence, the one that shares its cameras.
        scene: ``point_cloud.ply``, where there is one.
        moving: ``moving_part_points.ply``, where there is one.
        object: ``clean_object_points.ply``, where there is one.
        pins: ``pin_mask.json``, where there is one.
        image_masks: folder of the stills' masks, where there is one.
        video_masks: folder of the frames' masks, where there is one.
        inputs: everything that is read, by name.
    """

    root: Path
    model: ColmapModel
    stills: tuple[Posed, ...]
    sequences: tuple[str, ...]
    views: tuple[str, ...]
    frames: dict[str, dict[str, Path]]
    extra_views: dict[str, list[str]]
    left_out: dict[str, str]
    train: tuple[str, ...]
    test: tuple[str, ...]
    twins: dict[str, str]
    scene: Path | None
    moving: Path | None
    object: Path | None
    pins: Path | None
    image_masks: Path | None
    video_masks: Path | None
    inputs: dict[str, Path]

    def still_mask(self, path: Path) -> Path | None:
        """The mask of a still, or None where there are none."""
        return _mask(self.image_masks, path.relative_to(self.root / "images"))

    def frame_mask(self, path: Path) -> Path | None:
        """The mask of a frame, or None where there are none."""
        return _mask(self.video_masks, path.relative_to(self.root / "video_images"))


def find_files(root: Path, image_masks: Path | None = None, video_masks: Path | None = None) -> ReadyFiles:
    """Looks through a folder in the authors' layout; decodes no image.

    Raises:
        DataError: the model or ``meta.json`` is missing or malformed, an image is missing, or no sequence is usable.
    """
    folder = find_colmap(root)
    model, meta = read_colmap(folder), _Meta(root / "meta.json")
    videos: dict[str, dict[str, Path]] = {}
    place = root / "video_images"
    for found in sorted(place.iterdir(), key=lambda p: natural(p.name)) if place.is_dir() else ():
        match = _VIDEO.fullmatch(found.name)
        if match and found.is_dir():
            videos.setdefault(match[1], {})[match[2]] = found
    posed = {Path(image.name).stem for image in model.images}
    used, left_out = _usable(videos, posed, meta)
    if not used:
        raise DataError(f"{place}: no usable sequence here ({left_out or 'no folders seq_XXXXX_cam_XXXXX'}).")
    common = set.intersection(*(set(cameras) for cameras in used.values()))
    if not common:
        raise DataError(f"{place}: the sequences have no camera in common: { {n: list(c) for n, c in used.items()} }.")
    views = tuple(sorted(common, key=natural))
    image_masks, video_masks = _folder(image_masks, root / "masks"), _folder(video_masks, root / "video_masks")
    stills = _stills(root, model)
    files = {
        name: root / file if (root / file).is_file() else None
        for name, file in (
            ("scene", "point_cloud.ply"), ("moving", "moving_part_points.ply"), ("object", "clean_object_points.ply"),
            ("pins", "pin_mask.json"),
        )
    }  # fmt: skip
    ready = ReadyFiles(
        root, model, stills, tuple(used), views,
        {name: {view: cameras[view] for view in views} for name, cameras in used.items()},
        {name: sorted(set(cameras) - common) for name, cameras in used.items()},
        left_out, meta.lists["train"], meta.lists["test"], meta.twins, **files, image_masks=image_masks,
        video_masks=video_masks, inputs={},
    )  # fmt: skip
    ready.inputs.update(_inputs(ready, folder))
    return ready


def _folder(given: Path | None, usual: Path) -> Path | None:
    if given is not None and not given.is_dir():
        raise DataError(f"{given}: no such folder. Expected masks, named like the images.")
    return given or (usual if usual.is_dir() else None)


def _inputs(files: ReadyFiles, model: Path) -> dict[str, Path]:
    inputs = {f"sparse/{role}": path for role, path in colmap_files(model).items()}
    inputs["meta.json"] = files.root / "meta.json"
    inputs.update({f"images/{shot.photo.name}": shot.photo.path for shot in files.stills})
    masks = {f"masks/{shot.photo.name}": files.still_mask(shot.photo.path) for shot in files.stills}
    for cameras in files.frames.values():
        for folder in cameras.values():
            for path in list_images(folder):
                inputs[f"video_images/{folder.name}/{path.name}"] = path
                masks[f"video_masks/{folder.name}/{path.name}"] = files.frame_mask(path)
    masks.update(scene=files.scene, moving=files.moving, object=files.object, pins=files.pins)
    return {**inputs, **{name: path for name, path in masks.items() if path is not None}}


def _usable(
    videos: dict[str, dict[str, Path]], posed: set[str], meta: _Meta
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


def _stills(root: Path, model: ColmapModel) -> tuple[Posed, ...]:
    stills = []
    for image in model.images:
        if _VIDEO.fullmatch(Path(image.name).stem):
            continue
        photo = open_photo(root / "images" / image.name, image.name)
        stills.append(_posed(photo, model, image))
    return tuple(stills)


def _posed(photo: Photo, model: ColmapModel, image: ColmapImage) -> Posed:
    return Posed(photo, fitted(model.cameras[image.camera], photo), image.viewmat, image.xy, image.point_ids)


def sequence_poses(files: ReadyFiles, name: str) -> dict[str, Posed]:
    """The cameras of a sequence, its own or its twin's, for the size of its frames.

    Raises:
        DataError: a folder of frames is empty or has another shape than its camera.
    """
    images = {Path(image.name).stem: image for image in files.model.images}
    twin = files.twins.get(name, name)
    poses = {}
    for view, folder in files.frames[name].items():
        image = images.get(f"{name}_{view}") or images[f"{twin}_{view}"]
        first = list_images(folder)[0]
        poses[view] = _posed(open_photo(first, f"{name}/{view}"), files.model, image)
    return poses


def _mask(folder: Path | None, name: Path) -> Path | None:
    """The mask of an image: the same path with the ending of any image, or with ``.png`` appended."""
    if folder is None:
        return None
    for candidate in (folder / name.with_suffix(".png"), folder / name, folder / f"{name}.png"):
        if candidate.is_file():
            return candidate
    raise DataError(f"{folder / name.with_suffix('.png')}: no mask of {name}. Restore it, or leave out the folder.")


def read_pins(path: Path, count: int) -> np.ndarray:
    """(count,) bool of ``pin_mask.json``: a list of kernel numbers, or of one truth value per kernel.

    The list may stand alone or as the only list of an object.

    Raises:
        DataError: it is anything else, or a number is no kernel's.
    """
    try:
        data = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({error}).") from error
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


class _Meta:
    """``meta.json``: lists of sequences, and pairs that share their cameras."""

    def __init__(self, path: Path) -> None:
        data = read_json(path)
        self.lists = {key: tuple(_sequence(path, key, v) for v in _list(path, key, data.get(key))) for key in _LISTS}
        both = set(self.lists["train"]) & set(self.lists["test"])
        if both:
            raise DataError(f"{path}: fields 'train' and 'test' share {sorted(both)}.")
        self.twins: dict[str, str] = {}
        for key in (k for k in data if "twin" in k.lower()):
            value = data[key]
            pairs = list(value.items()) if isinstance(value, dict) else _list(path, key, value)
            for pair in pairs:
                if not isinstance(pair, list | tuple) or len(pair) != 2:
                    raise DataError(f"{path}: field '{key}' must hold pairs of sequences, got {pair!r:.60}.")
                a, b = (_sequence(path, key, v) for v in pair)
                self.twins[a], self.twins[b] = b, a


def _list(path: Path, key: str, value: Any) -> list[Any]:
    if value is None:
        return []
    if not isinstance(value, list):
        raise DataError(f"{path}: field '{key}' must be a list, got a {type(value).__name__}.")
    return value


def _sequence(path: Path, key: str, value: Any) -> str:
    """Name of a sequence that is given by its number, as text or number, or by its name."""
    text = str(value)
    if isinstance(value, bool) or not isinstance(value, int | str) or not re.fullmatch(r"(seq_)?[0-9]{1,9}", text):
        raise DataError(f"{path}: field '{key}': expected sequences like 'seq_00001' or 1, got {value!r:.60}.")
    return text if text.startswith("seq_") else f"seq_{int(text):05d}"
