"""Writes posed photos in our layout: undistorted images with ``transforms.json``, points, videos of fixed cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from data_prep.capture.cameras.lenses import Straightened, straighten
from data_prep.capture.cameras.sources import Posed, fitted
from data_prep.common.colmap import ColmapCamera, PointTable
from data_prep.common.photos import Photo, check_one_size, list_images, open_photo, write_picture
from data_prep.common.progress import Tick
from data_prep.common.stage import write_npz
from gausim.core.errors import DataError
from gausim.io.files import replacing


class PosedWriter:
    """Writes stills and sequences of one object without distortion; the maps of each lens are made once."""

    def __init__(self, tick: Tick) -> None:
        """Takes whom to tell of the progress."""
        self._tick = tick
        self._known = cache(lambda model, width, height, params, where: straighten(
            ColmapCamera(model, width, height, np.array(params)), where))  # fmt: skip

    def stills(self, out: Path, posed: Sequence[Posed]) -> None:
        """Writes ``images/*.png`` and ``transforms.json``; images that are there already stay."""
        check_one_size([shot.photo for shot in posed])
        files: dict[str, str] = {}
        for shot in posed:
            path = Path(shot.photo.name)
            name = "_".join((*path.parent.parts, path.stem)).replace("..", "_") + ".png"
            if name in files:
                raise DataError(f"{shot.photo.path}: '{files[name]}' and '{path}' would both be images/{name}.")
            files[name] = shot.photo.name
        for i, (name, shot) in enumerate(zip(files, posed, strict=True)):
            _write_photo(out / "images" / name, shot.photo, self._straight(shot))
            self._tick("images", i + 1, len(posed))
        entries = [{"file_path": f"images/{name}", "source": source} for name, source in files.items()]
        self._transforms(out / "transforms.json", posed, entries, None)

    def sequence(self, out: Path, folders: Mapping[str, Path], cameras: Mapping[str, Posed], fps: float | None) -> int:
        """Writes the frames of a sequence with their fixed cameras, and returns their number."""
        check_one_size([shot.photo for shot in cameras.values()])
        frames = {name: list_images(folders[name]) for name in cameras}
        counts = {name: len(paths) for name, paths in frames.items()}
        if len(set(counts.values())) > 1:
            raise DataError(
                f"{out.name}: cameras have different numbers of frames ({counts}). Make them again with ingest."
            )
        entries, posed = [], []
        for name, shot in cameras.items():
            for number, path in enumerate(frames[name]):
                frame = open_photo(path, path.name)
                frame = frame.turned() if shot.photo.upright else frame
                check_one_size([shot.photo, frame])
                _write_photo(out / name / f"{number:04d}.png", frame, self._straight(shot))
                entries.append({"file_path": f"{name}/{number:04d}.png", "camera": name, "frame": number})
                posed.append(shot)
                self._tick(out.name, len(posed), sum(counts.values()))
        self._transforms(out / "transforms.json", posed, entries, fps)
        return next(iter(counts.values()))

    def _straight(self, posed: Posed) -> Straightened:
        """The way from this photo to its pinhole camera."""
        camera = posed.camera
        return self._known(camera.model, camera.width, camera.height, tuple(camera.params), posed.photo.path.parent)

    def _transforms(self, path: Path, posed: Sequence[Posed], entries: list, fps: float | None) -> None:
        photo, ks = posed[0].photo, [self._straight(shot).intrinsics for shot in posed]
        names = tuple(shot.photo.name for shot in posed)
        write_cameras(path, [shot.viewmat for shot in posed], ks, (photo.width, photo.height), names, entries, fps)


def _write_photo(target: Path, photo: Photo, straight: Straightened) -> None:
    """Writes one photo without distortion unless it is there, without alpha where it is opaque."""
    if not target.is_file():
        pixels = straight(photo.read())
        write_picture(target, pixels if pixels[..., 3].min() < 255 else pixels[..., :3], 4)


def write_cameras(
    path: Path, viewmats: Sequence[np.ndarray], ks: Sequence[np.ndarray], size: tuple[int, int],
    names: tuple[str, ...], entries: list, fps: float | None,
) -> None:  # fmt: skip
    """Writes a ``transforms.json`` of pinhole cameras (4, 4), (3, 3) of one size, all of it or nothing."""
    import torch

    from gausim.core import Cameras
    from gausim.io.transforms import write_transforms

    viewmat, k = (torch.from_numpy(np.stack(parts)).float() for parts in (viewmats, ks))
    with replacing(path, typed=True) as temporary:
        write_transforms(temporary, Cameras(viewmat, k, *size, names).validated(str(path)), entries, fps=fps)


def write_points(path: Path, points: PointTable, xyz: np.ndarray, colors: np.ndarray) -> None:
    """Writes ``points.npz``: points (P, 3) [scene units], colors (P, 3) uint8, errors (P,) [pixels], tracks, ids."""
    write_npz(
        path, points=xyz.astype(np.float32), colors=colors, errors=points.error.astype(np.float32),
        tracks=points.tracks, ids=points.ids,
    )  # fmt: skip


def sequence_cameras(
    folder: Path, posed: Mapping[str, Posed], cameras: Sequence[str]
) -> tuple[dict[str, Posed], list[str]]:
    """Poses of a sequence's cameras, and the names of those that have none.

    A camera ``cam_0`` of ``seq_003`` is the image ``seq_003/cam_0`` (with any ending), one in a folder of that name,
    or, for cameras that never move, ``cam_0``.
    """
    found, missing = {}, []
    for name in cameras:
        shot = posed.get(f"{folder.name}/{name}") or posed.get(name)
        if shot is None:
            missing.append(name)
            continue
        first = open_photo(list_images(folder / name)[0], shot.photo.name)
        photo, camera = fitted(shot.camera, first)
        found[name] = Posed(photo, camera, shot.viewmat, shot.xy, shot.point_ids)
    return found, missing


def key_of(name: str) -> str:
    """The name of a camera's image as :func:`sequence_cameras` looks for it."""
    path = Path(name)
    parts = (*path.parent.parts, path.stem)
    # A frame in a folder of its camera, as ingest and our own layout name them.
    return "/".join(parts[:-1]) if path.stem.isdigit() and len(parts) > 1 else "/".join(parts)
