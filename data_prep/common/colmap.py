"""COLMAP sparse models, binary or text: cameras with their lenses, poses of the images, points.

pycolmap does not replace this reader: it reads some truncated files without an error, and it allocates memory for any
count in a file. This reader compares a count with the remaining bytes before it allocates memory.
"""

import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np

from gausim.core.errors import DataError

T = TypeVar("T")
# COLMAP's camera models: number in binary files, name in text files, count of parameters.
MODELS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12),
}  # fmt: skip
PARAMETERS = dict(MODELS.values())
# Models with two focal lengths; the others have one for both axes.
_TWO_FOCAL = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE")
_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
# Larger numbers indicate damage: they would overflow float32 in later computations.
_LARGEST = 1e12
_LARGEST_SIDE = 1 << 20
# COLMAP writes unit quaternions with all digits; edited files may have six.
_UNIT_TOLERANCE = 1e-2
# Point id of a keypoint without a point in the binary format.
_NO_POINT = (1 << 64) - 1
_CAMERA, _IMAGE, _POINT, _COUNT = (struct.Struct(f) for f in ("<IiQQ", "<I7dI", "<Q3d3BdQ", "<Q"))
_KEYPOINT, _FLOAT = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")]), np.dtype("<f8")
_TRACK_BYTES = 8
_POINT_COLUMNS = 8


@dataclass(frozen=True, eq=False)
class ColmapCamera:
    """Camera of a sparse model."""

    model: str  # a name of :data:`PARAMETERS`
    width: int  # of its images [pixels]
    height: int  # of its images [pixels]
    # (p,) float64, in COLMAP's order: focal lengths and centre [pixels], then distortion coefficients
    params: np.ndarray

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """Focal lengths and principal point: fx, fy, cx, cy [pixels]; (0, 0) is the corner of the first pixel."""
        two = self.model in _TWO_FOCAL
        fx, fy, cx, cy = self.params[:4] if two else self.params[[0, 0, 1, 2]]
        return float(fx), float(fy), float(cx), float(cy)

    @property
    def distorted(self) -> bool:
        """Whether the lens distorts: the model is no pinhole model and has non-zero coefficients."""
        if self.model in _PINHOLES:
            return False
        # Fisheye models and the field-of-view model distort even with zero coefficients.
        bent = "FISHEYE" in self.model or self.model == "FOV"
        return bent or bool(self.params[4 if self.model in _TWO_FOCAL else 3 :].any())

    def scaled(self, x: float, y: float) -> "ColmapCamera":
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
    """Registered image of a sparse model."""

    name: str  # its path within the folder of images
    camera: int  # key of the model's cameras
    viewmat: np.ndarray  # (4, 4) float64 world to camera, OpenCV axes
    xy: np.ndarray  # (m, 2) float64 keypoints with a point [pixels]
    point_ids: np.ndarray  # (m,) int64 ids of these points


@dataclass(frozen=True, eq=False)
class PointTable:
    """All of ``points3D``: ids (P,) int64, xyz (P, 3) and error (P,) float64, rgb (P, 3) uint8, tracks (P,) int64."""

    ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    error: np.ndarray
    tracks: np.ndarray


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse model."""

    path: Path  # the folder it was read from
    cameras: dict[int, ColmapCamera]  # by their number
    images: tuple[ColmapImage, ...]  # in the order of their names
    points: PointTable  # triangulated points; empty without a file of points


def find_colmap(folder: Path) -> Path:
    """The folder of a sparse model: ``folder``, else of ``sparse`` and numbered folders the one with most images.

    COLMAP writes ``sparse/0``, ``sparse/1`` and so on where it could not join all photos.

    Raises:
        DataError: none of these folders contains a model.
    """
    inner = [p for parent in (folder / "sparse", folder) if parent.is_dir() for p in sorted(parent.iterdir())]
    places = [folder, folder / "sparse", *(p for p in inner if p.name.isdecimal())]
    models = [p for p in places if any((p / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))]
    if not models:
        raise DataError(f"{folder}: no COLMAP model here (cameras.bin or cameras.txt, also not in sparse/0).")
    return folder if models[0] == folder else max(models, key=_image_count)


def _image_count(folder: Path) -> int:
    """Number of images that a model states; 0 where that cannot be read."""
    try:
        if (folder / "images.bin").is_file():
            with (folder / "images.bin").open("rb") as file:
                return int.from_bytes(file.read(8), "little")
        lines = (folder / "images.txt").read_bytes().splitlines()
    except OSError:
        return 0
    return sum(bool(line.strip()) and not line.startswith(b"#") for line in lines)


def colmap_files(folder: Path) -> dict[str, Path]:
    """The files of the model in ``folder`` by their role: ``cameras``, ``images`` and optionally ``points3D``.

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
    """Reads the sparse model in a folder, in binary form if it has both forms.

    Raises:
        DataError: a file is missing, truncated or malformed, a number is NaN, infinite or out of range, an id is
            duplicated, an image has an unknown camera, or a name leads out of the folder of images.
    """
    folder = Path(folder)
    files = colmap_files(folder)
    cameras: dict[int, ColmapCamera] = {}
    for where, number, camera in _rows_of(files["cameras"], _cameras_binary, _cameras_text):
        _check_unique(where, number, cameras)
        cameras[number] = _checked_camera(where, camera)
    images: dict[str, ColmapImage] = {}
    numbers: set[int] = set()
    for where, number, pose, image in _rows_of(files["images"], _images_binary, _images_text):
        _check_unique(where, number, numbers)
        _check_unique(where, image.name, images)
        numbers.add(number)
        images[image.name] = _checked_image(where, pose, image, cameras)
    if not images:
        raise DataError(f"{files['images']}: holds no image. Expected the registered images of a model.")
    points = _points(files["points3D"]) if "points3D" in files else no_points()
    return ColmapModel(folder, cameras, tuple(images[name] for name in sorted(images)), points)


def no_points() -> PointTable:
    """A table without rows."""
    empty = np.empty(0, np.int64)
    return PointTable(empty, np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0), empty)


def _rows_of(path: Path, binary: Callable[[Path], Iterator[T]], text: Callable[[Path], Iterator[T]]) -> Iterator[T]:
    return binary(path) if path.suffix == ".bin" else text(path)


def _checked_camera(where: str, camera: ColmapCamera) -> ColmapCamera:
    if not (0 < camera.width <= _LARGEST_SIDE and 0 < camera.height <= _LARGEST_SIDE):
        size = f"{camera.width} x {camera.height}"
        raise DataError(f"{where}: fields 'width', 'height' are {size}, expected 1 to {_LARGEST_SIDE} pixels.")
    _check_finite(f"{where}: field 'params'", camera.params)
    if min(camera.intrinsics[:2]) <= 0:
        raise DataError(f"{where}: field 'params': focal lengths must be positive, got {camera.intrinsics[:2]}.")
    return camera


def _checked_image(where: str, pose: np.ndarray, image: ColmapImage, cameras: dict[int, ColmapCamera]) -> ColmapImage:
    from scipy.spatial.transform import Rotation  # a fifth of a second, which --help of the stages need not take

    place, printable = (
        PurePosixPath(image.name.replace("\\", "/")),
        all(c.isprintable() or c.isspace() for c in image.name),
    )
    if not printable or set("\n\r\t") & set(image.name) or not place.name or place.is_absolute() or ".." in place.parts:
        raise DataError(f"{where}: field 'name' must be a path inside the folder of images, got {image.name!r:.80}.")
    if image.camera not in cameras:
        raise DataError(f"{where}: field 'camera_id' is {image.camera}, the cameras are {sorted(cameras)[:20]}.")
    quaternion, translation = pose[:4], pose[4:]
    _check_finite(f"{where}: field 'quaternion'", quaternion)
    _check_finite(f"{where}: field 'translation'", translation)
    _check_finite(f"{where}: keypoints", image.xy)
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise DataError(f"{where}: field 'quaternion' has length {length:.4g}, expected 1. Export the model again.")
    image.viewmat[:3, :3] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    image.viewmat[:3, 3] = translation
    return image


def _points(path: Path) -> PointTable:
    rows = list(_rows_of(path, _points_binary, _points_text))
    table = np.array([row for row, _ in rows]).reshape(-1, _POINT_COLUMNS)
    xyz, rgb, error = table[:, 1:4], table[:, 4:7], table[:, 7]
    # Comparisons with NaN are false, so it is refused too.
    if not ((rgb >= 0) & (rgb <= 255) & (rgb == np.floor(rgb))).all():
        raise DataError(f"{path}: field 'rgb' must hold whole numbers from 0 to 255. Export the model again.")
    _check_finite(f"{path}: field 'xyz'", xyz)
    _check_finite(f"{path}: field 'error'", error)
    ids = _ids(path, table[:, 0])
    known, counts = np.unique(ids, return_counts=True)
    if len(known) < len(ids):
        raise DataError(f"{path}: field 'id' {known[counts > 1][0]} stands twice. Export the model again.")
    return PointTable(ids, xyz, rgb.astype(np.uint8), error, np.array([track for _, track in rows], np.int64))


def _check_finite(where: str, values: np.ndarray) -> None:
    # One comparison: it is false for NaN as well.
    good = np.abs(values) <= _LARGEST
    if not good.all():
        first = values[tuple(np.argwhere(~good)[0])]
        raise DataError(
            f"{where}: expected finite numbers up to {_LARGEST:g}, got {first} (number {int(np.argmin(good))}; "
            f"{int((~good).sum())} of {good.size} are wrong). Export the model again."
        )


def _check_unique(where: str, value: int | str, known: Collection[int | str]) -> None:
    if value in known:
        raise DataError(f"{where}: '{value}' stands twice. Export the model again.")


class _Binary:
    """Sequential reader of a binary file, with an error at an early end."""

    def __init__(self, path: Path) -> None:
        self.path, self.at, self.data = path, 0, _contents(path)

    def need(self, count: int, where: str) -> int:
        """Advances by ``count`` bytes; returns the offset of the first."""
        left = len(self.data) - self.at
        if count > left:
            raise DataError(
                f"{where}: expected {count} more bytes, the file has {left}. It is truncated or its counts are wrong; "
                "copy or export the model again."
            )
        self.at += count
        return self.at - count

    def take(self, layout: struct.Struct, where: str) -> tuple:
        return layout.unpack_from(self.data, self.need(layout.size, where))

    def table(self, dtype: np.dtype, count: int, where: str) -> np.ndarray:
        return np.frombuffer(self.data, dtype, count, self.need(count * dtype.itemsize, where))

    def name(self, where: str) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise DataError(f"{where}: field 'name' has no end. The file is truncated; export it again.")
        return _decoded(self.data[self.need(end + 1 - self.at, where) : end], f"{where}: field 'name'")

    def records(self) -> Iterator[str]:
        """Names of the records for messages; after the last one, checks that the file ends."""
        (count,) = self.take(_COUNT, f"{self.path}: number of {self.path.stem}")
        for i in range(count):
            yield f"{self.path}: {self.path.stem}[{i}]"
        if self.at < len(self.data):
            left = len(self.data) - self.at
            raise DataError(f"{self.path}: {left} bytes follow the last record. Its counts are wrong; export it again.")


# Rows: place in the file, number, (of images) pose as w x y z and translation, record.
_CameraRow = tuple[str, int, ColmapCamera]
_ImageRow = tuple[str, int, np.ndarray, ColmapImage]


def _cameras_binary(path: Path) -> Iterator[_CameraRow]:
    file = _Binary(path)
    for where in file.records():
        number, model, width, height = file.take(_CAMERA, where)
        name, count = MODELS.get(model) or _unknown_model(where, str(model))
        params = file.table(_FLOAT, count, f"{where}: field 'params' of {name}").copy()
        yield where, number, ColmapCamera(name, width, height, params)


def _cameras_text(path: Path) -> Iterator[_CameraRow]:
    for where, line in _lines(path):
        words = line.split()
        if not words:
            continue
        model = words[1] if len(words) > 1 else ""
        expected = 4 + (PARAMETERS.get(model) or _unknown_model(where, model)[1])
        if len(words) != expected:
            raise DataError(f"{where}: expected {expected} words for {model}, got {len(words)}.")
        number, width, height = (_whole(where, words[i]) for i in (0, 2, 3))
        yield where, number, ColmapCamera(model, width, height, _numbers(where, words[4:]))


def _unknown_model(where: str, model: str) -> tuple[str, int]:
    known = ", ".join(PARAMETERS)
    raise DataError(f"{where}: field 'model' is {model!r:.40}, expected one of {known}. Undistort the model.")


def _images_binary(path: Path) -> Iterator[_ImageRow]:
    file = _Binary(path)
    for where in file.records():
        number, *pose, camera = file.take(_IMAGE, where)
        name = file.name(where)
        where = f"{where} '{name}'"
        (count,) = file.take(_COUNT, where)
        keypoints = file.table(_KEYPOINT, count, f"{where}: keypoints")
        seen = keypoints[keypoints["point"] != _NO_POINT]
        xy = np.stack((seen["x"], seen["y"]), 1)
        yield where, number, np.array(pose), ColmapImage(name, camera, np.eye(4), xy, _ids(path, seen["point"]))


def _images_text(path: Path) -> Iterator[_ImageRow]:
    lines = _lines(path)
    for where, line in lines:
        words = line.split(maxsplit=9)  # a name may hold spaces of all kinds
        if not words:
            continue
        if len(words) < 10:
            raise DataError(f"{where}: expected ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {len(words)} words.")
        number, camera = (_whole(where, words[i]) for i in (0, 8))
        pose, name = _numbers(where, words[1:8]), words[9]
        # Its keypoints are on the next line, which may be empty, or missing at the end of the file.
        below, text = next(lines, (where, ""))
        keypoints = text.split()
        if len(keypoints) % 3:
            raise DataError(f"{below}: keypoints: expected triples X Y POINT3D_ID, got {len(keypoints)} words.")
        table = _numbers(below, keypoints).reshape(-1, 3)
        seen = table[table[:, 2] != -1]
        image = ColmapImage(name, camera, np.eye(4), seen[:, :2].copy(), _ids(path, seen[:, 2]))
        yield f"{where} '{name}'", number, pose, image


def _points_binary(path: Path) -> Iterator[tuple[tuple, int]]:
    file = _Binary(path)
    for where in file.records():
        *row, track = file.take(_POINT, where)
        file.need(track * _TRACK_BYTES, f"{where}: field 'track'")
        yield tuple(row), track


def _points_text(path: Path) -> Iterator[tuple[np.ndarray, int]]:
    for where, line in _lines(path):
        words = line.split()
        track, odd = divmod(len(words) - _POINT_COLUMNS, 2)
        if words and (track < 0 or odd):
            raise DataError(f"{where}: expected ID X Y Z R G B ERROR and pairs of a track, got {len(words)} words.")
        if words:
            yield _numbers(where, words)[:_POINT_COLUMNS], track


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Place and text of every line except comments; empty lines are kept, as ``images.txt`` needs them."""
    for number, raw in enumerate(_contents(path).split(b"\n"), 1):
        where = f"{path}: line {number}"
        line = _decoded(raw, where).strip()
        if not line.startswith("#"):
            yield where, line


def _contents(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}). Expected a file of a COLMAP model.") from error


def _decoded(raw: bytes, where: str) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: is no UTF-8 text ({error.reason}). Export the model again.") from error


def _whole(where: str, word: str) -> int:
    # ASCII digits only: int() also accepts underscores and digits of other alphabets.
    if not (word.isascii() and word.isdigit()) or len(word) > 18:
        raise DataError(f"{where}: expected a whole number, got {word!r:.40}.")
    return int(word)


def _numbers(where: str, words: list[str]) -> np.ndarray:
    try:
        return np.array(words, np.float64)
    except ValueError as error:
        raise DataError(f"{where}: expected a number ({error!s:.80}).") from None


def _ids(path: Path, values: np.ndarray) -> np.ndarray:
    """Ids (n,) as int64, after checking that they are integers in [0, 2^53)."""
    if not ((values == np.floor(values)) & (values >= 0) & (values < 1 << 53)).all():
        raise DataError(f"{path}: a point's id is no whole number from 0 to 2^53. Export the model again.")
    return values.astype(np.int64)
