"""COLMAP sparse models: cameras with their lenses, poses of the images, points. Errors name the file and the field."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from gausim.core.errors import DataError
from gausim.io.colmap_files import CameraRow, ImageRow, PointTable, read_cameras, read_images, read_points

# Models with two focal lengths; the others have one for both axes.
_TWO_FOCAL = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE")
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
# Larger numbers are damage: they would overflow float32 somewhere down the line.
_LARGEST = 1e12
_LARGEST_SIDE = 1 << 20
# COLMAP writes unit quaternions with all digits; by hand some have six.
_UNIT_TOLERANCE = 1e-2


@dataclass(frozen=True, eq=False)
class ColmapCamera:
    """One camera.

    Attributes:
        model: a name of :data:`gausim.io.colmap_files.PARAMETERS`.
        width: of its images [pixels].
        height: of its images [pixels].
        params: (p,) float64, in COLMAP's order: focal lengths and centre [pixels], then the lens's coefficients.
    """

    model: str
    width: int
    height: int
    params: np.ndarray

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """Focal lengths and principal point: fx, fy, cx, cy [pixels]; (0, 0) is the corner of the first pixel."""
        two = self.model in _TWO_FOCAL
        fx, fy, cx, cy = self.params[:4] if two else self.params[[0, 0, 1, 2]]
        return float(fx), float(fy), float(cx), float(cy)

    @property
    def distorted(self) -> bool:
        """Whether straight lines are bent: neither a pinhole model nor one whose coefficients are all zero."""
        if self.model in PINHOLES:
            return False
        # Fisheye models and the field-of-view model bend with coefficients of zero, too.
        bent = "FISHEYE" in self.model or self.model == "FOV"
        return bent or bool(self.params[4 if self.model in _TWO_FOCAL else 3 :].any())

    def scaled(self, x: float, y: float) -> ColmapCamera:
        """The same camera for images of another size, ``x`` times as wide and ``y`` times as high.

        Raises:
            DataError: the model has one focal length, and ``x`` and ``y`` differ by more than the rounding to pixels.
        """
        width, height, params = round(self.width * x), round(self.height * y), self.params.copy()
        if self.model in _TWO_FOCAL:
            params[:4] *= (x, y, x, y)
        else:
            if abs(width - self.width * y) > 1 and abs(height - self.height * x) > 1:
                raise DataError(f"a {self.model} camera cannot be scaled by {x:g} across and {y:g} down.")
            params[:3] *= ((x * y) ** 0.5, x, y)
        return ColmapCamera(self.model, width, height, params)


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """One registered image.

    Attributes:
        name: its path within the folder of images.
        camera: key of the model's cameras.
        viewmat: (4, 4) float64 world to camera, OpenCV axes.
        xy: (m, 2) float64 keypoints that show a point [pixels].
        point_ids: (m,) int64 the points they show.
    """

    name: str
    camera: int
    viewmat: np.ndarray
    xy: np.ndarray
    point_ids: np.ndarray


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse model.

    Attributes:
        path: the folder it was read from.
        cameras: by their number.
        images: in the order of their names.
        points: what was triangulated; an empty table where there is no file of points.
    """

    path: Path
    cameras: dict[int, ColmapCamera]
    images: tuple[ColmapImage, ...]
    points: PointTable


def find_colmap(folder: Path) -> Path:
    """The folder of a sparse model: ``folder`` or ``sparse/0``, ``sparse`` or ``0`` in it.

    Raises:
        DataError: none of them holds one.
    """
    for place in (folder, folder / "sparse" / "0", folder / "sparse", folder / "0"):
        if any((place / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return place
    raise DataError(f"{folder}: no COLMAP model here (cameras.bin or cameras.txt, also not in sparse/0).")


def colmap_files(folder: Path) -> dict[str, Path]:
    """The files of the model in ``folder`` by their role: ``cameras``, ``images`` and, if it is there, ``points3D``.

    Raises:
        DataError: a file is missing.
    """
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    files = {role: folder / f"{role}{suffix}" for role in ("cameras", "images", "points3D")}
    for role in ("cameras", "images"):
        if not files[role].is_file():
            raise DataError(f"{files[role]}: no such file. A COLMAP model has cameras, images and points3D together.")
    return {role: path for role, path in files.items() if path.is_file()}


def read_colmap(folder: Path | str) -> ColmapModel:
    """Reads the sparse model in a folder, binary where both forms are there.

    Raises:
        DataError: a file is missing, cut off or malformed, a number is NaN, infinite or impossible, an id stands twice,
            an image names no camera of the model, or a name leads out of the folder of images.
    """
    folder = Path(folder)
    files = colmap_files(folder)
    cameras: dict[int, ColmapCamera] = {}
    for row in read_cameras(files["cameras"]):
        _unique(files["cameras"], row.where, row.number, cameras)
        cameras[row.number] = _camera(files["cameras"], row)
    images: dict[int | str, ColmapImage] = {}
    for entry in read_images(files["images"]):
        image = _image(files["images"], entry, cameras)
        for key in (entry.number, entry.name):
            _unique(files["images"], entry.where, key, images)
            images[key] = image
    if not images:
        raise DataError(f"{files['images']}: holds no image. Expected the registered images of a model.")
    points = _points(files["points3D"]) if "points3D" in files else no_points()
    named = sorted(key for key in images if isinstance(key, str))
    return ColmapModel(folder, cameras, tuple(images[name] for name in named), points)


def no_points() -> PointTable:
    """A table without rows."""
    empty = np.empty(0, np.int64)
    return PointTable(empty, np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0), empty)


def _camera(path: Path, row: CameraRow) -> ColmapCamera:
    where = f"{path}: {row.where}"
    if not (0 < row.width <= _LARGEST_SIDE and 0 < row.height <= _LARGEST_SIDE):
        size = f"{row.width} x {row.height}"
        raise DataError(f"{where}: fields 'width', 'height' are {size}, expected 1 to {_LARGEST_SIDE} pixels.")
    _check_finite(f"{where}: field 'params'", row.params)
    camera = ColmapCamera(row.model, row.width, row.height, row.params)
    if min(camera.intrinsics[:2]) <= 0:
        raise DataError(f"{where}: field 'params': focal lengths must be positive, got {camera.intrinsics[:2]}.")
    return camera


def _image(path: Path, row: ImageRow, cameras: dict[int, ColmapCamera]) -> ColmapImage:
    where, place = f"{path}: {row.where}", PurePosixPath(row.name)
    if not row.name.isprintable() or not place.name or place.is_absolute() or ".." in place.parts:
        raise DataError(f"{where}: field 'name' must be a path inside the folder of images, got {row.name!r:.80}.")
    if row.camera not in cameras:
        raise DataError(f"{where}: field 'camera_id' is {row.camera}, the cameras are {sorted(cameras)[:20]}.")
    quaternion, translation = row.pose[:4], row.pose[4:]
    for field, values in (
        ("field 'quaternion'", quaternion),
        ("field 'translation'", translation),
        ("keypoints", row.xy),
    ):
        _check_finite(f"{where}: {field}", values)
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise DataError(f"{where}: field 'quaternion' has length {length:.4g}, expected 1. Export the model again.")
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix(), translation
    return ColmapImage(row.name, row.camera, viewmat, row.xy, row.point_ids)


def _points(path: Path) -> PointTable:
    table = read_points(path)
    for field in ("xyz", "error"):
        _check_finite(f"{path}: field '{field}'", getattr(table, field))
    ids, counts = np.unique(table.ids, return_counts=True)
    if len(ids) < len(table.ids):
        raise DataError(f"{path}: field 'id' {ids[counts > 1][0]} stands twice. Export the model again.")
    return table


def _check_finite(where: str, values: np.ndarray) -> None:
    # One comparison: it is false for NaN as well.
    good = np.abs(values) <= _LARGEST
    if not good.all():
        first = values[tuple(np.argwhere(~good)[0])]
        raise DataError(
            f"{where}: expected finite numbers up to {_LARGEST:g}, got {first} (number {int(np.argmin(good))}; "
            f"{int((~good).sum())} of {good.size} are wrong). Export the model again."
        )


def _unique(path: Path, where: str, value: int | str, known: Collection[int | str]) -> None:
    if value in known:
        raise DataError(f"{path}: {where}: '{value}' stands twice. Export the model again.")
