"""Inputs of the stage of poses: photos, frames of sequences, and poses that somebody else found.

These are COLMAP models, ``transforms.json`` with any lens, or projection matrices.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_prep.common.command import Options, option
from data_prep.common.photos import Photo, list_images, natural, open_photo
from data_prep.common.stage import MANIFEST, read_manifest
from gausim.core.errors import ConfigError, DataError
from gausim.io.colmap import ColmapCamera, ColmapModel, PointTable, colmap_files, find_colmap, no_points, read_colmap
from gausim.io.plain_json import read_json

# Endings with which projection matrices are named after their image.
_MATRIX_ENDING = re.compile(r"([._-](P|proj|projection|camera))?$", re.IGNORECASE)
_MATRIX_SUFFIXES = (".txt", ".p", ".proj", ".projection")
# Columns of pixels may stand askew by so many pixels over the height of an image before it shows.
_SKEW_PIXELS = 1.0
# A decomposed matrix must give back itself, relative to its largest entry.
_DECOMPOSED = 1e-6


@dataclass(frozen=True)
class Sources(Options):
    """Options for the inputs of the poses."""

    images: Path | None = option(None, "photos of the rest state", metavar="DIR")
    sequences: Path | None = option(
        None, "result of ingest, or folders SEQ/CAM of frames; cameras stand still through a sequence, and its first "
        "frame shows the rest state", metavar="DIR",
    )  # fmt: skip
    fps: float | None = option(None, "frames per second of the sequences (default: that of ingest)", metavar="RATE")
    colmap: Path | None = option(
        None, "COLMAP model to take over, binary or text, for --images of any size", metavar="DIR"
    )
    transforms: Path | None = option(
        None, "transforms.json to take over, also with OPENCV or OPENCV_FISHEYE distortion", metavar="FILE"
    )
    projections: Path | None = option(
        None, "3 x 4 matrices to take over, as text: NAME.txt or NAME_P.txt for NAME.jpg", metavar="DIR"
    )
    scale: float = option(1.0, "size of the photos / size the matrices are for (%(default)s)")

    def __post_init__(self) -> None:
        """Checks that they go together."""
        super().__post_init__()
        taken = [n for n in ("colmap", "transforms", "projections") if getattr(self, n) is not None]
        if len(taken) > 1:
            raise ConfigError(f"--{' and --'.join(taken)}: poses come from one of them; give one.")
        if self.images is None and self.transforms is None and (self.sequences is None or taken):
            raise ConfigError("--images: give the folder of the photos.")

    @property
    def kind(self) -> str:
        """``mapping`` or what is taken over."""
        return next((n for n in ("colmap", "transforms", "projections") if getattr(self, n) is not None), "mapping")


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

    @staticmethod
    def of(sources: Sources) -> Material:
        """Looks what is there.

        Raises:
            DataError: something that was named is missing or malformed.
        """
        stills: tuple[Photo, ...] = ()
        posed, inputs = _taken_over(sources)
        if sources.images is not None and posed is None:
            stills = tuple(open_photo(path, path.name) for path in list_images(sources.images))
            inputs = {f"images/{photo.name}": photo.path for photo in stills}
        folders, fps = _sequences(sources)
        for folder, cameras in folders.items():
            for camera in cameras:
                inputs.update({f"{folder.name}/{camera}/{p.name}": p for p in list_images(folder / camera)})
        return Material(stills, posed, folders, fps, inputs)


def _taken_over(sources: Sources) -> tuple[tuple[list[Posed], PointTable] | None, dict[str, Path]]:
    """Poses that somebody else found, and the files that say so, with their photos."""
    if sources.kind == "mapping":
        return None, {}
    points = no_points()
    if sources.colmap is not None and sources.images is not None:
        folder = find_colmap(sources.colmap)
        model = read_colmap(folder)
        posed, points = from_model(model, photos_of_model(model, sources.images)), model.points
        files = colmap_files(folder)
    elif sources.transforms is not None:
        posed, files = read_lens_transforms(sources.transforms), {"transforms": sources.transforms}
    else:
        assert sources.projections is not None and sources.images is not None
        posed = read_projections(sources.projections, sources.images, sources.scale)
        files = {f"images/{p.name}": p for p in list_images(sources.images)}
        files.update({f"projections/{p.name}": p for p in matrix_files_of(sources.projections)})
    return (posed, points), {**files, **{f"images/{shot.photo.name}": shot.photo.path for shot in posed}}


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


def from_model(model: ColmapModel, photos: dict[str, Photo]) -> list[Posed]:
    """The images of a COLMAP model, with lenses brought to the photos' size.

    Raises:
        DataError: a photo is missing or has another shape than the model's.
    """
    posed = []
    for image in model.images:
        photo = photos.get(image.name)
        if photo is None:
            raise DataError(f"{model.path}: image '{image.name}' is not in the folder of images. Restore it.")
        camera = model.cameras[image.camera]
        x, y = photo.width / camera.width, photo.height / camera.height
        posed.append(Posed(photo, fitted(camera, photo), image.viewmat, image.xy * (x, y), image.point_ids))
    return posed


def fitted(camera: ColmapCamera, photo: Photo) -> ColmapCamera:
    """The camera for a photo that was made smaller or larger after it was calibrated.

    Raises:
        DataError: the photo has another shape, so it was cropped or turned.
    """
    x, y = photo.width / camera.width, photo.height / camera.height
    # Rounding both sides to pixels changes a ratio by no more than this.
    if abs(x / y - 1) > 1 / min(photo.width, photo.height) + 1 / min(camera.width, camera.height):
        raise DataError(
            f"{photo.path}: is {photo.width}x{photo.height}, its camera was calibrated for "
            f"{camera.width}x{camera.height}, another shape. Use the calibrated images (not cropped, not turned)."
        )
    return camera if (x, y) == (1, 1) else camera.scaled(x, y)


def photos_of_model(model: ColmapModel, folder: Path) -> dict[str, Photo]:
    """The photos of a model's images in a folder, by name.

    Raises:
        DataError: one is missing or no image.
    """
    return {image.name: open_photo(folder / image.name, image.name) for image in model.images}


def read_lens_transforms(path: Path) -> list[Posed]:
    """The frames of a ``transforms.json`` whose lenses may be distorted (nerfstudio's models), for their photos' size.

    Raises:
        DataError: the file, a field or a photo is missing or malformed, a pose is no rotation with a translation, or
            the lens is of a model that cannot be straightened.
    """
    from gausim.core import Cameras
    from gausim.io.transforms import image_name, pinhole_of, read_entries, size_field, viewmat_of

    data = read_json(path)
    posed, names = [], set()
    for where, entry in read_entries(data, path):
        fields = {**data, **entry}
        name = image_name(entry, where)
        if name in names:
            raise DataError(f"{where}: field 'file_path' '{name}' stands twice.")
        names.add(name)
        photo = open_photo(path.parent / name, name.removeprefix("./"))
        size = size_field(fields, where) or (photo.width, photo.height)
        k = pinhole_of(fields, size, where)
        viewmat = viewmat_of(entry, where)
        Cameras(viewmat[None], k[None], *size, (name,)).validated(str(path))
        camera = _lens(fields, k.double().numpy(), size, where)
        empty = np.empty(0, np.int64)
        posed.append(Posed(photo, fitted(camera, photo), viewmat.double().numpy(), np.empty((0, 2)), empty))
    return posed


def _lens(fields: dict[str, Any], k: np.ndarray, size: tuple[int, int], where: str) -> ColmapCamera:
    from gausim.io.transforms import PINHOLE_MODELS, number_field

    def coefficients(*keys: str) -> list[float]:
        return [number_field(fields, key, where) if key in fields else 0.0 for key in keys]

    model = fields.get("camera_model", "OPENCV")
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


def read_projections(folder: Path, images: Path, scale: float) -> list[Posed]:
    """Images with a 3 x 4 projection matrix each, in text files that are named after them.

    ``00006.txt``, ``00006_P.txt`` or ``00006.P`` belongs to ``00006.jpg`` and to ``00006._c.jpg``.

    Raises:
        DataError: fewer than three images have a matrix, two claim one, or a matrix is malformed, no camera's, of
            pixels that are askew, or of a centre far outside of its image.
        ConfigError: the scale is not positive.
    """
    if not 0 < scale < 1e3:
        raise ConfigError(f"--scale {scale:g}: expected size of the images / size that the matrices are for, e.g. 0.5.")
    posed: list[Posed] = []
    for image, matrix in match_matrices(folder, list_images(images)).items():
        photo = open_photo(image, image.name)
        k, viewmat = factors(matrix)
        fx, fy, cx, cy = params = scale * k[[0, 1, 0, 1], [0, 1, 2, 2]]
        skew = abs(k[0, 1] * scale) / fy * photo.height / 2
        if skew > _SKEW_PIXELS:
            raise DataError(
                f"{matrix}: its pixels are askew by {skew:.1f} at the edge; expected a matrix without skew."
            )
        if not (0 < cx < photo.width and 0 < cy < photo.height):
            raise DataError(
                f"{matrix}: its centre is at pixel ({cx:.0f}, {cy:.0f}), the image is {photo.width}x{photo.height}. "
                "Give --scale if the matrix is for another size."
            )
        camera = ColmapCamera("PINHOLE", photo.width, photo.height, params)
        posed.append(Posed(photo, camera, viewmat, np.empty((0, 2)), np.empty(0, np.int64)))
    return posed


def match_matrices(folder: Path, images: Sequence[Path]) -> dict[Path, Path]:
    """For each image the file of its matrix; images without one are left out.

    Raises:
        DataError: fewer than three images have a matrix, or two claim one.
    """
    matrices = {path: _MATRIX_ENDING.sub("", path.stem) for path in matrix_files_of(folder)}
    owner: dict[Path, Path] = {}
    for image in images:
        fitting = [p for p, key in matrices.items() if re.match(re.escape(key) + r"($|[^0-9A-Za-z])", image.name)]
        if not fitting:
            continue
        longest = max(len(matrices[p]) for p in fitting)
        chosen = [p for p in fitting if len(matrices[p]) == longest]
        if len(chosen) > 1 or chosen[0] in owner:
            other = owner.get(chosen[0], chosen[-1]).name
            raise DataError(f"{chosen[0]}: belongs to '{image.name}' and '{other}' alike. Rename them.")
        owner[chosen[0]] = image
    if len(owner) < 3:
        raise DataError(
            f"{folder}: {len(owner)} of {len(images)} images have a projection matrix, expected at least 3. "
            "Name them alike: NAME.jpg and NAME.txt or NAME_P.txt."
        )
    return {image: matrix for matrix, image in owner.items()}


def matrix_files_of(folder: Path) -> list[Path]:
    """The text files in a folder that may hold projection matrices.

    Raises:
        DataError: there is no such folder, or none in it.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder. Expected one with projection matrices (3 x 4, text).")
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in _MATRIX_SUFFIXES and p.is_file())
    if not found:
        raise DataError(f"{folder}: no projection matrices here (looked for {', '.join(_MATRIX_SUFFIXES)}).")
    return found


def factors(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """K (3, 3) and viewmat (4, 4) of the projection matrix (3, 4) in a file, which is defined up to a factor.

    Raises:
        DataError: the file holds anything else than twelve numbers, or they are no camera's.
    """
    from scipy.linalg import rq  # slow to import

    matrix = _read_matrix(path)
    p = matrix * np.sign(np.linalg.det(matrix[:, :3]))
    if not np.linalg.cond(p[:, :3]) < 1e9:
        raise DataError(f"{path}: the matrix is singular; expected K [R | t] of a camera.")
    k, rotation = rq(p[:, :3])
    signs = np.sign(np.diag(k))
    k, viewmat = k * signs, np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = signs[:, None] * rotation, np.linalg.solve(k, p[:, 3])
    error = np.abs(k @ viewmat[:3] - p).max() / np.abs(p).max()
    if not error < _DECOMPOSED or np.linalg.det(viewmat[:3, :3]) < 0:
        raise DataError(f"{path}: cannot be decomposed into K [R | t]; expected the matrix of a camera.")
    return k / k[2, 2], viewmat


def _read_matrix(path: Path) -> np.ndarray:
    """A (3, 4) float64 matrix from text: twelve numbers, perhaps after a line ``CONTOUR``."""
    if path.stat().st_size > 1 << 16:
        raise DataError(f"{path}: {path.stat().st_size} bytes are too many for a 3 x 4 matrix.")
    try:
        words = path.read_text("utf-8").removeprefix("CONTOUR").replace(",", " ").split()
        values = np.array([float(word) for word in words])
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: expected a 3 x 4 matrix of numbers ({error!s:.80}).") from error
    if len(values) != 12 or not (np.abs(values) < 1e12).all():
        raise DataError(f"{path}: expected 12 finite numbers, a 3 x 4 projection matrix, got {len(values)}.")
    return values.reshape(3, 4)
