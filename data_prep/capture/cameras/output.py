"""Writes posed photos in our layout: undistorted images with ``transforms.json``, points, videos of fixed cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from data_prep.capture.cameras.lenses import Straightened, straighten
from data_prep.capture.cameras.sources import Posed, fitted
from data_prep.common.photos import Photo, list_images, open_photo, read_photo, write_image
from data_prep.common.progress import Tick
from data_prep.common.stage import write_npz
from gausim.core.errors import DataError
from gausim.io.colmap import PointTable
from gausim.io.files import replacing
from gausim.io.pixels import read_header


class PosedWriter:
    """Writes stills and sequences of one object without distortion; the maps of each lens are made once.

    Attributes:
        bare: names of what has images without alpha: ``stills``, sequences.
    """

    def __init__(self, tick: Tick, mask_of: Callable[[Path], Path | None] = lambda path: None) -> None:
        """Takes whom to tell of the progress, and what gives the file of a photo's mask, which becomes its alpha."""
        self._tick, self._mask_of = tick, mask_of
        self._known: dict[tuple, Straightened] = {}
        self.bare: set[str] = set()

    def stills(self, out: Path, posed: Sequence[Posed]) -> None:
        """Writes ``images/*.png`` and ``transforms.json``; images that are there already stay.

        Raises:
            DataError: the photos differ in size, two would get one name, a lens cannot be straightened, or a mask has
                another size than its photo.
        """
        check_one_size([shot.photo for shot in posed])
        files: dict[str, str] = {}
        for shot in posed:
            path = Path(shot.photo.name)
            name = "_".join((*path.parent.parts, path.stem)).replace("..", "_") + ".png"
            if name in files:
                raise DataError(f"{shot.photo.path}: '{files[name]}' and '{path}' would both be images/{name}.")
            files[name] = shot.photo.name
        for i, (name, shot) in enumerate(zip(files, posed, strict=True)):
            self._image(out / "images" / name, shot.photo, self._straight(shot), "stills")
            self._tick("images", i + 1, len(posed))
        entries = [{"file_path": f"images/{name}", "source": source} for name, source in files.items()]
        self._transforms(out / "transforms.json", posed, entries, None)

    def sequence(self, out: Path, folders: Mapping[str, Path], cameras: Mapping[str, Posed], fps: float | None) -> int:
        """Writes the frames of a sequence with their fixed cameras, and returns their number.

        Raises:
            DataError: cameras differ in size or in number of frames, or a frame or a mask is of another size.
        """
        check_one_size([shot.photo for shot in cameras.values()])
        frames = {name: list_images(folders[name]) for name in cameras}
        counts = {name: len(paths) for name, paths in frames.items()}
        if len(set(counts.values())) > 1:
            raise DataError(
                f"{out.name}: cameras have different numbers of frames ({counts}). Make them again with ingest."
            )
        entries, posed = [], []
        for name, shot in cameras.items():
            straight = self._straight(shot)
            for number, path in enumerate(frames[name]):
                frame = open_photo(path, path.name)
                check_one_size([shot.photo, frame])
                self._image(out / name / f"{number:04d}.png", frame, straight, out.name)
                entries.append({"file_path": f"{name}/{number:04d}.png", "camera": name, "frame": number})
                posed.append(shot)
                self._tick(out.name, len(posed), sum(counts.values()))
        self._transforms(out / "transforms.json", posed, entries, fps)
        return next(iter(counts.values()))

    def _straight(self, posed: Posed) -> Straightened:
        """The way from this photo to its pinhole camera."""
        camera = posed.camera
        key = (camera.model, camera.width, camera.height, camera.params.tobytes())
        if key not in self._known:
            try:
                self._known[key] = straighten(camera)
            except DataError as error:
                raise DataError(f"{posed.photo.path}: {error}") from error
        return self._known[key]

    def _image(self, target: Path, photo: Photo, straight: Straightened, what: str) -> None:
        """Writes one photo without distortion, unless it is there, and remembers if it has no alpha."""
        if target.is_file():
            header = read_header(target)
            alpha = header is not None and header.mode == "RGBA"
        else:
            pixels, mask = read_photo(photo), self._mask_of(photo.path)
            if mask is not None:
                pixels = np.concatenate((pixels[..., :3], _read_mask(mask, photo)), axis=-1)
            write_image(target, straight(pixels))
            alpha = pixels.shape[2] == 4
        if not alpha:
            self.bare.add(what)

    def _transforms(self, path: Path, posed: Sequence[Posed], entries: list, fps: float | None) -> None:
        photo, ks = posed[0].photo, [self._straight(shot).intrinsics for shot in posed]
        names = tuple(shot.photo.name for shot in posed)
        write_cameras(path, [shot.viewmat for shot in posed], ks, (photo.width, photo.height), names, entries, fps)


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


def _read_mask(path: Path, photo: Photo) -> np.ndarray:
    """(H, W, 1) uint8 of a mask: its alpha if it has one, else its brightness."""
    mask = read_photo(open_photo(path, path.name))
    if mask.shape[:2] != (photo.height, photo.width):
        size = f"{mask.shape[1]}x{mask.shape[0]}"
        raise DataError(f"{path}: is {size}, its image is {photo.width}x{photo.height}. Export the mask again.")
    return mask[..., 3:] if mask.shape[2] == 4 else mask.max(-1, keepdims=True)


def check_one_size(photos: Sequence[Photo]) -> None:
    """Raises :class:`DataError` naming a photo whose size is not that of the first."""
    for photo in photos:
        if (photo.width, photo.height) != (photos[0].width, photos[0].height):
            raise DataError(
                f"{photo.path}: is {photo.width}x{photo.height}, {photos[0].path.name} is "
                f"{photos[0].width}x{photos[0].height}; use photos of one size, all upright or all lengthwise."
            )


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

    Raises:
        DataError: a frame has another shape than its camera was calibrated for.
    """
    found, missing = {}, []
    for name in cameras:
        shot = posed.get(f"{folder.name}/{name}") or posed.get(name)
        if shot is None:
            missing.append(name)
            continue
        first = open_photo(list_images(folder / name)[0], shot.photo.name)
        found[name] = Posed(first, fitted(shot.camera, first), shot.viewmat, shot.xy, shot.point_ids)
    return found, missing


def key_of(name: str) -> str:
    """The name of a camera's image as :func:`sequence_cameras` looks for it."""
    path = Path(name)
    parts = (*path.parent.parts, path.stem)
    # A frame in a folder of its camera, as ingest and our own layout name them.
    return "/".join(parts[:-1]) if path.stem.isdigit() and len(parts) > 1 else "/".join(parts)
