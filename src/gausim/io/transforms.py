"""Reader and writer of nerfstudio/Blender ``transforms.json``: posed images, camera to world in OpenGL axes."""

import json
import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Cameras, DataError
from gausim.io.files import slashed
from gausim.io.pixels import SUFFIXES, read_header
from gausim.io.plain_json import read_json

# Camera models without distortion, or with distortion that is checked to be zero.
PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
# What other programs state and what becomes of it; fields of neither table are unknown to them.
REFUSED = {
    "is_fisheye": "Undistort the images with `gausim prepare poses`.",
    "lens": "Export a pinhole or OpenCV lens.",
    "rolling_shutter": "Use images of a global shutter, or set the field to 0.",
    "from_mitsuba": "Export camera to world in OpenGL axes.",
    "mask_path": "Write the masks into the images' alpha with `gausim prepare poses --transforms FILE`.",
}
# They describe how other programs normalise or start; the poses stand as they are.
LEFT_ASIDE = (
    "aabb_scale", "scale", "offset", "up", "applied_transform", "applied_scale", "ply_file_path",
    "orientation_override", "sharpness", "rotation", "depth_file_path", "colmap_im_id", "n_extra_learnable_dims",
)  # fmt: skip
IMAGE_SUFFIXES = (*SUFFIXES, ".PNG", ".JPG", ".JPEG", ".TIF", ".TIFF")
_LONGEST_NAME = 255
# Relative difference of focal lengths above which two fields contradict each other.
_SAME_FOCAL = 0.02
_Row = tuple[float, float, float, float]
# OpenGL cameras look along -z with y up, OpenCV cameras along +z with y down.
OPENGL_TO_OPENCV = (1.0, -1.0, -1.0, 1.0)


@dataclass(frozen=True)
class PosedFrame:
    """One entry of ``frames``."""

    path: Path  # image file
    camera: str  # name of the camera; by default the image's folder
    frame: int | None  # frame number within its sequence; None for a still
    heldout: bool  # whether the entry is excluded from training
    time: float | None = None  # moment in the file's own unit, which orders frames without a number


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Content of a ``transforms.json``."""

    path: Path  # the file it was read from
    frames: tuple[PosedFrame, ...]  # its N entries
    cameras: Cameras  # their N cameras, in the same order
    fps: float | None  # frames per second, if stated


def read_transforms(path: Path) -> PosedImages:
    """Reads a ``transforms.json`` of undistorted pinhole images of one size.

    Intrinsics may be global or per frame, as ``fl_x`` (``fl_y``, ``cx``, ``cy``) or ``camera_angle_x``
    (``camera_angle_y``) [radian]; without ``w`` and ``h`` the size of the first image is used (Blender's layout).

    Raises:
        DataError: the file is missing or not JSON, a field is missing, malformed or of another size, the lens distorts,
            or a pose is not a rotation plus a translation.
    """
    data = read_json(path)
    size: tuple[int, int] | None = None
    frames, viewmats, intrinsics = [], [], []
    for field, entry in read_entries(data, path):
        fields = lens_fields(data, entry)
        refuse_fields(fields, field)
        frames.append(_frame(path.parent, entry, field))
        here = size_field(fields, field) or size
        if here is None:
            found = read_header(frames[-1].path)
            if found is None:
                raise DataError(f"{field}: has no 'w' and 'h', and {frames[-1].path} cannot be read to find them.")
            here = found.width, found.height
        size = size or here
        if here != size:
            raise DataError(f"{field}: is {here[0]}x{here[1]}, frames[0] is {size[0]}x{size[1]}; use one image size.")
        viewmats.append(viewmat_of(entry, field))
        intrinsics.append(_intrinsics(fields, here, field))
    assert size is not None
    names = tuple(f"{f.path.parent.name}/{f.path.name}" for f in frames)
    cameras = Cameras(torch.stack(viewmats), torch.stack(intrinsics), size[0], size[1], names).validated(str(path))
    fps = number_field(data, "fps", str(path)) if "fps" in data else None
    return PosedImages(path, tuple(frames), cameras, fps)


def write_transforms(path: Path, cameras: Cameras, entries: list[dict[str, Any]], *, fps: float | None = None) -> None:
    """Writes entries (``file_path`` and further keys) with the pose of the camera of the same index.

    Intrinsics are written globally if all cameras have equal K, otherwise per entry.
    """
    data: dict[str, Any] = {"camera_model": "OPENCV"}
    if torch.equal(cameras.Ks, cameras.Ks[0].expand_as(cameras.Ks)):
        data["camera_angle_x"] = 2 * math.atan(cameras.width / (2 * float(cameras.Ks[0, 0, 0])))
        data.update(_lens_fields(cameras.Ks[0]))
    else:
        entries = [{**entry, **_lens_fields(k)} for entry, k in zip(entries, cameras.Ks, strict=True)]
    data.update(w=cameras.width, h=cameras.height)
    if fps is not None:
        data["fps"] = fps
    poses = torch.linalg.inv(cameras.viewmats.double()) * torch.tensor(OPENGL_TO_OPENCV, dtype=torch.float64)
    data["frames"] = [{**entry, "transform_matrix": pose.tolist()} for entry, pose in zip(entries, poses, strict=True)]
    path.write_text(json.dumps(data, indent=1))


def _lens_fields(k: Float[Tensor, "3 3"]) -> dict[str, float]:
    return {"fl_x": float(k[0, 0]), "fl_y": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2])}


def read_entries(data: dict[str, Any], path: Path) -> list[tuple[str, dict[str, Any]]]:
    """The entries of ``frames``, each with its place for messages.

    Raises:
        DataError: there are none, or one is no object.
    """
    entries = data.get("frames")
    if not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        raise DataError(f"{path}: field 'frames' must be a non-empty list of objects.")
    return [(f"{path}: frames[{i}]", entry) for i, entry in enumerate(entries)]


def number_field(fields: dict[str, Any], key: str, where: str) -> float:
    """A field that must be a finite number, or :class:`DataError` that names it."""
    value = fields.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise DataError(f"{where}: field '{key}' must be a finite number, got {value!r}.")
    return float(value)


def lens_fields(data: dict[str, Any], entry: dict[str, Any]) -> dict[str, Any]:
    """The fields of the file and of an entry, which wins: its focal length replaces the file's in either form."""
    own = [axis for axis in "xy" if f"fl_{axis}" in entry or f"camera_angle_{axis}" in entry]
    # One across alone counts downwards, too.
    replaced = [f"{form}_{axis}" for form in ("fl", "camera_angle") for axis in ("xy" if "x" in own else own)]
    return {**{key: value for key, value in data.items() if key not in replaced}, **entry}


def refuse_fields(fields: dict[str, Any], field: str, *, obeyed: Collection[str] = ()) -> None:
    """Raises a :class:`DataError` that names a field of :data:`REFUSED` which is set and not ``obeyed``."""
    for key, remedy in REFUSED.items():
        value = fields.get(key)
        if key in obeyed or not (any(value) if isinstance(value, list) else value):
            continue
        raise DataError(f"{field}: field '{key}' is {value!r:.60}, which is not supported. {remedy}")


def image_name(entry: dict[str, Any], field: str, folder: Path, key: str = "file_path") -> str:
    """File name of an entry's image (or of what ``key`` names) in a folder, with the extension of the file there.

    Blender omits the extension, programs of Windows write backslashes, and images may have been converted since.

    Raises:
        DataError: the entry has no file name or an invalid one, or several images fit it.
    """
    name = entry.get(key)
    if not isinstance(name, str) or not name:
        raise DataError(f"{field}: field '{key}' must name an image, got {name!r:.80}.")
    # File systems have no longer names, and querying one raises an OSError.
    if any(len(part.encode()) > _LONGEST_NAME for part in name.split("/")) or not name.isprintable():
        raise DataError(f"{field}: field '{key}' is no name of a file: {name!r:.60}.")
    name = slashed(folder, name)
    if (folder / name).is_file():
        return name
    stem, suffix = name, ""
    if Path(name).suffix.lower() in IMAGE_SUFFIXES:
        suffix = Path(name).suffix
        stem = name.removesuffix(suffix)
    found = [stem + each for each in IMAGE_SUFFIXES if len(Path(stem).name.encode()) + len(each) <= _LONGEST_NAME
             and (folder / (stem + each)).is_file()]  # fmt: skip
    distinct = [one for i, one in enumerate(found)
                if not any((folder / one).samefile(folder / other) for other in found[:i])]  # fmt: skip
    if len(distinct) > 1:
        raise DataError(
            f"{field}: field '{key}' '{name}' fits {' and '.join(distinct)}. Write the name with its extension."
        )
    return distinct[0] if distinct else stem + (suffix or ".png")


def _frame(folder: Path, entry: dict[str, Any], field: str) -> PosedFrame:
    path = folder / image_name(entry, field, folder)
    number = entry.get("frame")
    if number is not None and (not isinstance(number, int) or number < 0):
        raise DataError(f"{field}: field 'frame' must be a frame number from 0 on, got {number!r}.")
    time = number_field(entry, "time", field) if entry.get("time") is not None else None
    return PosedFrame(path, str(entry.get("camera", path.parent.name)), number, bool(entry.get("heldout", False)), time)


def size_field(fields: dict[str, Any], field: str) -> tuple[int, int] | None:
    """Width and height that ``w`` and ``h`` state [pixels]; None without them.

    Raises:
        DataError: one is missing, malformed or not positive.
    """
    if "w" not in fields and "h" not in fields:
        return None
    size = int(number_field(fields, "w", field)), int(number_field(fields, "h", field))
    if min(size) < 1:
        raise DataError(f"{field}: fields 'w', 'h' must be positive, got {size}.")
    return size


def viewmat_of(entry: dict[str, Any], field: str) -> Float[Tensor, "4 4"]:
    """World to camera (OpenCV) of an entry's ``transform_matrix``; its rotation is checked elsewhere.

    The last row may be left out.

    Raises:
        DataError: the field is missing, or not a finite 3 x 4 or 4 x 4 matrix with the last row of a pose.
    """
    if "transform_matrix" not in entry:
        raise DataError(f"{field}: field 'transform_matrix' is missing (camera to world, 4 x 4, OpenGL axes).")
    wrong = f"{field}: field 'transform_matrix' must be a finite 4 x 4 matrix that ends in 0 0 0 1."
    try:
        rows = msgspec.convert(entry["transform_matrix"], list[_Row])
    except msgspec.ValidationError as error:
        raise DataError(wrong) from error
    rows += [(0.0, 0.0, 0.0, 1.0)] * (len(rows) == 3)
    if len(rows) != 4 or not max(abs(a - b) for a, b in zip(rows[3], (0, 0, 0, 1), strict=True)) <= 1e-6:
        raise DataError(wrong)
    pose = torch.tensor(rows, dtype=torch.float64) * torch.tensor(OPENGL_TO_OPENCV, dtype=torch.float64)
    # The transpose is the inverse of a rotation, and unlike a general inverse it preserves errors of the matrix for
    # Cameras.validated (a singular pose must reach that message, not a linear-algebra error).
    rotation = pose[:3, :3].T
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ pose[:3, 3]
    return viewmat.float()


def _intrinsics(fields: dict[str, Any], size: tuple[int, int], field: str) -> Float[Tensor, "3 3"]:
    model = fields.get("camera_model", "PINHOLE")
    if model not in PINHOLE_MODELS:
        raise DataError(f"{field}: camera_model {model!r} is not supported, expected one of {PINHOLE_MODELS}.")
    bent = {key: fields[key] for key in DISTORTION if key in fields and number_field(fields, key, field) != 0}
    if bent:
        raise DataError(f"{field}: the lens is distorted ({bent}); undistort the images and set these fields to 0.")
    return pinhole_of(fields, size, field)


def pinhole_of(fields: dict[str, Any], size: tuple[int, int], field: str) -> Float[Tensor, "3 3"]:
    """K [pixels] of an image of ``size`` (width, height) by the fields of its entry and file; distortion is ignored.

    Raises:
        DataError: no focal length is given, or a number is malformed or out of range.
    """
    focal = [_focal(fields, axis, length, field) for axis, length in zip("xy", size, strict=True)]
    fl_x = focal[0]
    if fl_x is None:
        raise DataError(f"{field}: neither field 'fl_x' [pixels] nor 'camera_angle_x' [radian] is there.")
    fl_y = focal[1] if focal[1] is not None else fl_x
    usual = {"cx": size[0] / 2, "cy": size[1] / 2}
    cx, cy = (number_field({**usual, **fields}, key, field) for key in usual)
    if fl_x <= 0 or fl_y <= 0:
        raise DataError(f"{field}: focal lengths must be positive, got fl_x {fl_x:g}, fl_y {fl_y:g}.")
    return torch.tensor([[fl_x, 0.0, cx], [0.0, fl_y, cy], [0.0, 0.0, 1.0]])


def _focal(fields: dict[str, Any], axis: str, length: int, field: str) -> float | None:
    """Focal length along an axis [pixels] by ``fl_x`` or ``camera_angle_x``; None where neither is there."""
    key, angle = f"camera_angle_{axis}", fields.get(f"camera_angle_{axis}")
    if f"fl_{axis}" in fields:
        focal = number_field(fields, f"fl_{axis}", field)
        by_angle = length / (2 * math.tan(angle / 2)) if isinstance(angle, float) and 0 < angle < math.pi else focal
        if focal > 0 and abs(by_angle - focal) > _SAME_FOCAL * focal:
            raise DataError(
                f"{field}: fields 'fl_{axis}' ({focal:g} pixels) and '{key}' ({angle:g} radian, which is "
                f"{by_angle:.4g} pixels) contradict each other. Take one of them out."
            )
        return focal
    if key not in fields:
        return None
    angle = number_field(fields, key, field)
    if not 0 < angle < math.pi:
        degrees = f" In degrees that would be {math.radians(angle):.4g} radian." if math.pi <= angle < 180 else ""
        raise DataError(
            f"{field}: field '{key}' must be between 0 and pi [radian], got {angle:g}.{degrees} Write the field of "
            "view in radian."
        )
    return length / (2 * math.tan(angle / 2))
