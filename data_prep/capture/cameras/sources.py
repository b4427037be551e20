"""Inputs of the stage of poses: photos, frames of sequences, and poses that somebody else found.

These are COLMAP models, or ``transforms.json`` with any lens.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.common.colmap import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    PointTable,
    colmap_files,
    find_colmap,
    no_points,
    read_colmap,
)  # fmt: skip
from data_prep.common.command import Options, option
from data_prep.common.photos import Photo, list_images, open_photo, unread_in
from data_prep.common.stage import MANIFEST, read_manifest
from gausim.core.errors import ConfigError, DataError
from gausim.io.files import natural, slashed
from gausim.io.pixels import SUFFIXES
from gausim.io.plain_json import read_json


@dataclass(frozen=True)
class Sources(Options):
    """Options for the inputs of the poses."""

    images: Path | None = option(None, "pose these photos of the rest state", metavar="DIR")
    sequences: Path | None = option(
        None, "pose the result of ingest, or folders SEQ/CAM of frames; cameras are static through a sequence, and "
        "its first frame shows the rest state", metavar="DIR",
    )  # fmt: skip
    fps: float | None = option(
        None, "state the frames per second of the sequences (default: that of ingest)", metavar="RATE"
    )
    colmap: Path | None = option(
        None, "take over this COLMAP model, binary or text, for --images of any size", metavar="DIR"
    )
    transforms: Path | None = option(
        None, "take over this transforms.json, also with OPENCV or OPENCV_FISHEYE distortion", metavar="FILE"
    )

    def __post_init__(self) -> None:
        """Checks that they go together."""
        super().__post_init__()
        if self.colmap is not None and self.transforms is not None:
            raise ConfigError("--colmap and --transforms: poses come from one of them; give one.")
        if self.images is None and self.transforms is None and (self.sequences is None or self.colmap is not None):
            raise ConfigError("--images: give the folder of the photos.")

    @property
    def kind(self) -> str:
        """``mapping`` or what is taken over."""
        return "colmap" if self.colmap is not None else "transforms" if self.transforms is not None else "mapping"


@dataclass(frozen=True, eq=False)
class Posed:
    """One photo with its pose and lens."""

    photo: Photo  # the file
    camera: ColmapCamera  # its lens, for the photo's own size
    viewmat: np.ndarray  # (4, 4) float64 world to camera, OpenCV axes
    xy: np.ndarray  # (m, 2) float64 pixels of the photo that show points
    point_ids: np.ndarray  # (m,) int64 which points


@dataclass(frozen=True)
class Material:
    """Photos, frames and poses found in the sources."""

    stills: tuple[Photo, ...]  # photos whose poses are to be found
    # poses that are taken over, with their points; None where they are to be found
    posed: tuple[list[Posed], PointTable] | None
    sequences: dict[Path, tuple[str, ...]]  # the folders of sequences with the names of their cameras
    fps: float | None  # frames per second of the sequences
    inputs: dict[str, Path]  # all files that are read, by the names that the manifest gives them
    without_pose: tuple[str, ...] = ()  # photos beside those whose poses are taken over
    note: str = ""  # about pictures that are not read

    @staticmethod
    def of(sources: Sources) -> Material:
        """Looks what is there."""
        stills: tuple[Photo, ...] = ()
        posed, inputs = _taken_over(sources)
        if sources.images is not None and posed is None:
            stills = tuple(open_photo(path, path.name) for path in list_images(sources.images))
            inputs = {f"images/{photo.name}": photo.path for photo in stills}
        folders, fps = _sequences(sources)
        for folder, cameras in folders.items():
            for camera in cameras:
                inputs.update({f"{folder.name}/{camera}/{p.name}": p for p in list_images(folder / camera)})
        without: tuple[str, ...] = ()
        if sources.images is not None and posed is not None:
            known, every = {shot.photo.path for shot in posed[0]}, sources.images.rglob("*")
            left = (p for p in every if p.suffix.lower() in SUFFIXES and not p.name.startswith(".") and p not in known)
            without = tuple(sorted((p.relative_to(sources.images).as_posix() for p in left), key=natural))
        note = unread_in(sources.images) if sources.images is not None else ""
        return Material(stills, posed, folders, fps, inputs, without, note)


def _taken_over(sources: Sources) -> tuple[tuple[list[Posed], PointTable] | None, dict[str, Path]]:
    """Poses that somebody else found, and the files that say so, with their photos."""
    if sources.colmap is not None and sources.images is not None:
        folder = find_colmap(sources.colmap)
        model = read_colmap(folder)
        posed, points, files = from_model(model, sources.images), model.points, colmap_files(folder)
    elif sources.transforms is not None:
        posed, points, files = read_lens_transforms(sources.transforms), no_points(), {"transforms": sources.transforms}
    else:
        return None, {}
    masks = {f"masks/{shot.photo.name}": shot.photo.mask for shot in posed if shot.photo.mask is not None}
    return (posed, points), {**files, **{f"images/{shot.photo.name}": shot.photo.path for shot in posed}, **masks}


def _sequences(sources: Sources) -> tuple[dict[Path, tuple[str, ...]], float | None]:
    if sources.sequences is None:
        return {}, sources.fps
    root, fps = sources.sequences, sources.fps
    if (root / MANIFEST).is_file():
        found = read_manifest(root, "ingest")["results"].get("fps")
        fps, root = fps if fps is not None else found, root / "sequences"
    if not root.is_dir():
        raise DataError(f"{root}: no such folder. Expected one folder per sequence in it, with one per camera.")
    folders: dict[Path, tuple[str, ...]] = {}
    for folder in sorted((p for p in root.iterdir() if p.is_dir()), key=lambda p: natural(p.name)):
        cameras = sorted((p.name for p in folder.iterdir() if p.is_dir()), key=natural)
        if cameras:
            folders[folder] = tuple(cameras)
    if not folders:
        raise DataError(f"{root}: no sequences here. Expected folders like seq_000/cam_0 with frames.")
    if fps is None or not 0 < fps < 1e4:
        raise ConfigError(f"--fps: expected frames per second of the sequences, got {fps}.")
    return folders, float(fps)


def from_model(model: ColmapModel, images: Path | Mapping[str, Photo]) -> list[Posed]:
    """The images of a COLMAP model, with lenses brought to the photos' size.

    Args:
        model: the model.
        images: the folder of the photos, or the photos by the model's names.
    """
    if not isinstance(images, Mapping):
        names = {image.name: slashed(images, image.name) for image in model.images}
        images = {name: open_photo(images / found, found) for name, found in names.items()}
    return [posed_image(images[image.name], model, image) for image in model.images]


def posed_image(photo: Photo, model: ColmapModel, image: ColmapImage) -> Posed:
    """A photo with the pose and the lens of a model's image."""
    old = model.cameras[image.camera]
    photo, camera = fitted(old, photo)
    scale = photo.width / old.width, photo.height / old.height
    return Posed(photo, camera, image.viewmat, image.xy * scale, image.point_ids)


def fitted(camera: ColmapCamera, photo: Photo) -> tuple[Photo, ColmapCamera]:
    """The camera for a photo that was made smaller or larger after it was calibrated, and the photo as it saw it.

    Pixels are those that are stored, unless the camera was calibrated for the picture as its EXIF data turn it.
    """
    for seen in (photo, photo.turned()):
        x, y = seen.width / camera.width, seen.height / camera.height
        # Rounding both sides to pixels changes a ratio by no more than this.
        if abs(x / y - 1) <= 1 / min(seen.width, seen.height) + 1 / min(camera.width, camera.height):
            return seen, camera if (x, y) == (1, 1) else camera.scaled(x, y)
    raise DataError(
        f"{photo.path}: is {photo.width}x{photo.height}, its camera was calibrated for "
        f"{camera.width}x{camera.height}, another shape. Use the calibrated images (not cropped, not turned)."
    )


def read_lens_transforms(path: Path) -> list[Posed]:
    """The frames of a ``transforms.json``, whose lenses may be distorted (nerfstudio's models)."""
    from gausim.core import Cameras
    from gausim.io.transforms import (
        image_name,
        lens_fields,
        pinhole_of,
        read_entries,
        refuse_fields,
        size_field,
        viewmat_of,
    )

    data = read_json(path)
    posed, names = [], set()
    for where, entry in read_entries(data, path):
        fields = lens_fields(data, entry)
        refuse_fields(fields, where, obeyed=("is_fisheye", "mask_path"))
        name = image_name(entry, where, path.parent)
        if name in names:
            raise DataError(f"{where}: field 'file_path' '{name}' stands twice.")
        names.add(name)
        photo = open_photo(path.parent / name, name.removeprefix("./"))
        if entry.get("mask_path"):
            photo = replace(photo, mask=path.parent / image_name(entry, where, path.parent, "mask_path"))
        size = size_field(fields, where) or (photo.width, photo.height)
        k = pinhole_of(fields, size, where)
        viewmat = viewmat_of(entry, where)
        Cameras(viewmat[None], k[None], *size, (name,)).validated(str(path))
        camera = _lens(fields, k.double().numpy(), size, where)
        empty = np.empty(0, np.int64)
        photo, camera = fitted(camera, photo)
        posed.append(Posed(photo, camera, viewmat.double().numpy(), np.empty((0, 2)), empty))
    return posed


def _lens(fields: dict[str, Any], k: np.ndarray, size: tuple[int, int], where: str) -> ColmapCamera:
    from gausim.io.transforms import PINHOLE_MODELS, number_field

    def coefficients(*keys: str) -> list[float]:
        return [number_field(fields, key, where) if key in fields else 0.0 for key in keys]

    model = "OPENCV_FISHEYE" if fields.get("is_fisheye") else fields.get("camera_model", "OPENCV")
    head = [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
    if model == "OPENCV_FISHEYE":
        params = head + coefficients("k1", "k2", "k3", "k4")
    elif model in PINHOLE_MODELS:
        model = "FULL_OPENCV"
        params = head + coefficients("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        if not any(params[8:]):
            model, params = "OPENCV", params[:8]
    else:
        known = ", ".join((*PINHOLE_MODELS, "OPENCV_FISHEYE"))
        raise DataError(f"{where}: field 'camera_model' is {model!r:.40}, expected one of {known}.")
    return ColmapCamera(model, *size, np.array(params))
