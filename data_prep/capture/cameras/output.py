"""Writes posed photos in our layout: undistorted images with ``transforms.json``, points, videos of fixed cameras."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from data_prep.capture.cameras.lenses import Straightened, straighten
from data_prep.capture.cameras.sources import Posed, fitted
from data_prep.common.photos import Photo, list_images, open_photo, read_photo, write_png
from data_prep.common.progress import Tick
from gausim.core.errors import DataError
from gausim.io.colmap_files import PointTable
from gausim.io.files import replacing, write_durably

MaskOf = Callable[[Path], Path | None]


def no_mask(path: Path) -> None:
    """There is no mask of this image."""


class Straighteners:
    """Straightens photos of a few cameras; the maps of each are made once."""

    def __init__(self) -> None:
        """Starts with none."""
        self._known: dict[tuple, Straightened] = {}

    def __call__(self, posed: Posed) -> Straightened:
        """The way from this photo to its pinhole camera.

        Raises:
            DataError: its lens cannot be straightened; names the photo.
        """
        camera = posed.camera
        key = (camera.model, camera.width, camera.height, camera.params.tobytes())
        if key not in self._known:
            try:
                self._known[key] = straighten(camera)
            except DataError as error:
                raise DataError(f"{posed.photo.path}: {error}") from error
        return self._known[key]


def write_stills(
    out: Path,
    posed: Sequence[Posed],
    straighteners: Straighteners,
    tick: Tick,
    *,
    mask_of: MaskOf = no_mask,
    bare: set[str] | None = None,
) -> None:
    """Writes ``images/*.png`` and ``transforms.json``; images that are there already stay.

    Args:
        out: where.
        posed: the photos.
        straighteners: of the run.
        tick: told of the progress.
        mask_of: file of a photo's mask, which becomes its alpha.
        bare: gets ``stills`` where a photo has no alpha.

    Raises:
        DataError: the photos differ in size, two would get one name, or a mask has another size than its photo.
    """
    check_one_size([shot.photo for shot in posed])
    files: dict[str, str] = {}
    for shot in posed:
        name = f"{_flat(shot.photo.name)}.png"
        if name in files:
            raise DataError(f"{shot.photo.path}: '{files[name]}' and '{shot.photo.name}' would both be images/{name}.")
        files[name] = shot.photo.name
    for i, (name, shot) in enumerate(zip(files, posed, strict=True)):
        if not _write_image(out / "images" / name, shot.photo, straighteners(shot), mask_of) and bare is not None:
            bare.add("stills")
        tick("images", i + 1, len(posed))
    entries = [{"file_path": f"images/{name}", "source": source} for name, source in files.items()]
    _write_transforms(out / "transforms.json", posed, straighteners, entries, None)


def _write_image(target: Path, photo: Photo, straight: Straightened, mask_of: MaskOf) -> bool:
    """Writes one photo without distortion, unless it is there, and tells whether it has alpha."""
    if target.is_file():
        return _has_alpha(target)
    pixels, mask = read_photo(photo), mask_of(photo.path)
    if mask is not None:
        pixels = np.concatenate((pixels[..., :3], _read_mask(mask, photo)), axis=-1)
    write_png(target, straight(pixels))
    return pixels.shape[2] == 4


def _has_alpha(path: Path) -> bool:
    from PIL import Image

    with Image.open(path) as image:
        return image.mode == "RGBA"


def _read_mask(path: Path, photo: Photo) -> np.ndarray:
    """(H, W, 1) uint8 of a mask: its alpha if it has one, else its brightness."""
    mask = read_photo(open_photo(path, path.name))
    if mask.shape[:2] != (photo.height, photo.width):
        size = f"{mask.shape[1]}x{mask.shape[0]}"
        raise DataError(f"{path}: is {size}, its image is {photo.width}x{photo.height}. Export the mask again.")
    return mask[..., 3:] if mask.shape[2] == 4 else mask.max(-1, keepdims=True)


def _flat(name: str) -> str:
    path = Path(name)
    return "_".join((*path.parent.parts, path.stem)).replace("..", "_")


def check_one_size(photos: Sequence[Photo]) -> None:
    """Raises :class:`DataError` naming a photo whose size is not that of the first."""
    for photo in photos:
        if (photo.width, photo.height) != (photos[0].width, photos[0].height):
            raise DataError(
                f"{photo.path}: is {photo.width}x{photo.height}, {photos[0].path.name} is "
                f"{photos[0].width}x{photos[0].height}; use photos of one size, all upright or all lengthwise."
            )


def write_sequence(
    out: Path,
    folders: Mapping[str, Path],
    cameras: Mapping[str, Posed],
    fps: float | None,
    straighteners: Straighteners,
    tick: Tick,
    *,
    mask_of: MaskOf = no_mask,
    bare: set[str] | None = None,
) -> int:
    """Writes the frames of a sequence without distortion, with their fixed cameras, and returns their number.

    Args:
        out: folder of the sequence in the result.
        folders: per camera the folder of its frames.
        cameras: poses by the cameras' names.
        fps: frames per second where known.
        straighteners: of the run.
        tick: told of the progress.
        mask_of: file of a frame's mask, which becomes its alpha.
        bare: gets the sequence's name where a frame has no alpha.

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
    total, done = sum(counts.values()), 0
    entries, posed = [], []
    for name, shot in cameras.items():
        straight = straighteners(shot)
        for number, path in enumerate(frames[name]):
            frame = open_photo(path, path.name)
            check_one_size([shot.photo, frame])
            alpha = _write_image(out / name / f"{number:04d}.png", frame, straight, mask_of)
            if not alpha and bare is not None:
                bare.add(out.name)
            entries.append({"file_path": f"{name}/{number:04d}.png", "camera": name, "frame": number})
            posed.append(shot)
            done += 1
            tick(out.name, done, total)
    _write_transforms(out / "transforms.json", posed, straighteners, entries, fps)
    return next(iter(counts.values()))


def _write_transforms(
    path: Path, posed: Sequence[Posed], straighteners: Straighteners, entries: list, fps: float | None
) -> None:
    import torch

    from gausim.core import Cameras
    from gausim.io.transforms import write_transforms

    cameras = Cameras(
        torch.from_numpy(np.stack([shot.viewmat for shot in posed])).float(),
        torch.from_numpy(np.stack([straighteners(shot).intrinsics for shot in posed])).float(),
        posed[0].photo.width,
        posed[0].photo.height,
        tuple(shot.photo.name for shot in posed),
    )
    with replacing(path, typed=True) as temporary:
        write_transforms(temporary, cameras.validated(str(path)), entries, fps=fps)


def write_points(path: Path, points: PointTable, xyz: np.ndarray, colors: np.ndarray) -> None:
    """Writes ``points.npz``: points (P, 3) [scene units], colors (P, 3) uint8, errors (P,) [pixels], tracks, ids."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer, points=xyz.astype(np.float32), colors=colors, errors=points.error.astype(np.float32),
        tracks=points.tracks, ids=points.ids,
    )  # fmt: skip
    write_durably(path, buffer.getvalue())


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
        wanted = (f"{folder.name}/{name}", name)
        shot = next((posed[w] for w in wanted if w in posed), None)
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
