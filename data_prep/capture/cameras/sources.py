"""Poses that somebody else found: COLMAP models, ``transforms.json`` with any lens, projection matrices."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg

from data_prep.common.photos import Photo, list_images, open_photo
from gausim.core.errors import ConfigError, DataError
from gausim.io.colmap import ColmapCamera, ColmapModel
from gausim.io.plain_json import read_json

# Endings with which projection matrices are named after their image.
_MATRIX_ENDING = re.compile(r"([._-](P|proj|projection|camera))?$", re.IGNORECASE)
_MATRIX_SUFFIXES = (".txt", ".p", ".proj", ".projection")
# Columns of pixels may stand askew by so many pixels over the height of an image before it shows.
_SKEW_PIXELS = 1.0
# A decomposed matrix must give back itself, relative to its largest entry.
_DECOMPOSED = 1e-6


@dataclass(frozen=True, eq=False)
class Posed:
    """One photo with its pose and lens."""

    photo: Photo  # the file
    camera: ColmapCamera  # its lens, for the photo's own size
    viewmat: np.ndarray  # (4, 4) float64 world to camera, OpenCV axes
    xy: np.ndarray  # (m, 2) float64 pixels of the photo that show points
    point_ids: np.ndarray  # (m,) int64 which points


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
        DataError: fewer than three images have a matrix, two claim one, or a matrix is malformed or no camera's.
        ConfigError: the scale is not positive.
    """
    if not 0 < scale < 1e3:
        raise ConfigError(f"--scale {scale:g}: expected size of the images / size that the matrices are for, e.g. 0.5.")
    posed: list[Posed] = []
    for image, matrix in match_matrices(folder, list_images(images)).items():
        photo = open_photo(image, image.name)
        camera, viewmat = decompose(read_matrix(matrix), photo, scale, str(matrix))
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


def read_matrix(path: Path) -> np.ndarray:
    """A (3, 4) float64 matrix from text: twelve numbers, perhaps after a line ``CONTOUR``.

    Raises:
        DataError: it holds anything else.
    """
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


def factors(matrix: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """K (3, 3) and viewmat (4, 4) of a projection matrix (3, 4) that is defined up to a factor.

    Raises:
        DataError: it is no camera's.
    """
    p = matrix * np.sign(np.linalg.det(matrix[:, :3]))
    if not np.linalg.cond(p[:, :3]) < 1e9:
        raise DataError(f"{where}: the matrix is singular; expected K [R | t] of a camera.")
    k, rotation = scipy.linalg.rq(p[:, :3])
    signs = np.sign(np.diag(k))
    k, viewmat = k * signs, np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = signs[:, None] * rotation, np.linalg.solve(k, p[:, 3])
    error = np.abs(k @ viewmat[:3] - p).max() / np.abs(p).max()
    if not error < _DECOMPOSED or np.linalg.det(viewmat[:3, :3]) < 0:
        raise DataError(f"{where}: cannot be decomposed into K [R | t]; expected the matrix of a camera.")
    return k / k[2, 2], viewmat


def decompose(matrix: np.ndarray, photo: Photo, scale: float, where: str) -> tuple[ColmapCamera, np.ndarray]:
    """Camera and viewmat (4, 4) of a projection matrix (3, 4) for a photo ``scale`` times as large.

    Raises:
        DataError: it is no camera's, its pixels are askew, or its centre is far outside of the photo.
    """
    k, viewmat = factors(matrix, where)
    fx, fy, cx, cy = k[0, 0] * scale, k[1, 1] * scale, k[0, 2] * scale, k[1, 2] * scale
    skew = abs(k[0, 1] * scale) / fy * photo.height / 2
    if skew > _SKEW_PIXELS:
        raise DataError(f"{where}: its pixels are askew by {skew:.1f} at the edge; expected a matrix without skew.")
    if not (0 < cx < photo.width and 0 < cy < photo.height):
        raise DataError(
            f"{where}: its centre is at pixel ({cx:.0f}, {cy:.0f}), the image is {photo.width}x{photo.height}. Give "
            "--scale if the matrix is for another size."
        )
    return ColmapCamera("PINHOLE", photo.width, photo.height, np.array([fx, fy, cx, cy])), viewmat
