"""Gaussian scenes as 3DGS PLY files (INRIA layout) with a side file of masks.

The PLY is a standard 3DGS file that every viewer reads; the masks and the volume constant, which only the dynamics
needs, are in ``<stem>.masks.npz`` next to it.
"""

import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.recfunctions import structured_to_unstructured
from plyfile import PlyData, PlyListProperty, PlyParseError

from gausim.core.errors import DataError, SceneError
from gausim.core.outliers import outliers
from gausim.core.scene import GaussianScene
from gausim.io.compressed_ply import decompressed, is_compressed
from gausim.io.files import replacing
from gausim.io.npz import read_npz

logger = logging.getLogger(__name__)
MASK_SUFFIX = ".masks.npz"
MASK_NAMES = ("simulated", "pinned", "foreground")

# Formats of splats that are not PLY.
OTHER_FORMATS = (".splat", ".ksplat", ".spz", ".sog", ".rad")
# Steps of float32 up to this fraction of the body's extent lose nothing that is visible.
COARSEST_STEP = 1e-4
# Extents between which products of a kernel's three variances stay within float32 [scene units].
LEAST_EXTENT, MOST_EXTENT = 1e-3, 1e6
# f_rest has (d + 1)^2 - 1 coefficients for each of three channels.
_REST_COUNTS = (0, 9, 24, 45)
_POSITION, _COLOR = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
_SHAPE = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


def masks_path(path: Path | str) -> Path:
    """The side file of a scene: ``scene.ply`` -> ``scene.masks.npz``."""
    path = Path(path)
    return path.with_name(path.stem + MASK_SUFFIX)


def read_ply(path: Path) -> PlyData:
    """Reads a PLY file in text or binary of either byte order.

    Raises:
        DataError: the file is missing, no PLY file, cut off, or (if binary) longer than its header says.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file. Expected a scene, points or a mesh in PLY format.")
    try:
        with path.open("rb") as file:
            ply = PlyData.read(file)
            left = 0 if ply.text else os.path.getsize(path) - file.tell()
    except (PlyParseError, ValueError, TypeError, OverflowError, MemoryError, OSError) as error:
        raise DataError(f"{path}: cannot be read as PLY ({error!s:.200}). Copy or export it again.") from error
    # Some writers end with a line break; more means that a count in the header is wrong.
    if left > 2:
        raise DataError(f"{path}: has {left} bytes after what its header declares. Export it again.")
    return ply


def load_scene(path: Path | str, *, masks: Path | str | None = None, name: str | None = None) -> GaussianScene:
    """Reads a 3DGS PLY with SH degree 0..3 in any property order, as little endian, big endian or text.

    Normals and unknown properties are skipped; doubles are rounded to float32. Masks are by default those of
    ``<stem>.masks.npz`` next to the PLY; without it every kernel is simulated and foreground and none is pinned.
    The scene's name is by default the file's stem. Kernels that are most likely wrong are named in a warning.

    Raises:
        SceneError: naming the file and the property that is missing, malformed, NaN, infinite or a zero quaternion.
    """
    path = Path(path)
    table = _read_vertices(path)
    rest = _rest_names(path, table.dtype.names or ())
    _check_extent(path, table)
    values = torch.from_numpy(_columns(path, table, [*_POSITION, *_SHAPE, *_COLOR, *rest]))
    means, opacity, log_scales, quats, color, high = values.split((3, 1, 3, 4, 3, len(rest)), dim=1)
    sh = torch.cat([color[:, None], high.reshape(len(values), 3, -1).transpose(1, 2)], dim=1)
    try:
        scene = GaussianScene.create(
            means=means.contiguous(),
            log_scales=log_scales.contiguous(),
            quats=quats.contiguous(),
            opacity_logits=opacity[:, 0].contiguous(),
            sh=sh,
            name=path.stem if name is None else name,
        )
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error
    side = masks_path(path) if masks is None else Path(masks)
    scene = load_masks(scene, side) if masks is not None or side.is_file() else scene
    for found in outliers(scene):
        some = 0 < int(found.mask.sum()) < scene.count
        remedy = f" `gausim inspect {path} --clean OUT.ply` writes the scene without them." if some else ""
        logger.warning("%s: %s%s", path, found.what, remedy)
    return scene


def save_scene(scene: GaussianScene, path: Path | str, *, masks: bool = True) -> None:
    """Writes the scene as little-endian float32 PLY in INRIA order, and its masks next to it; replaces atomically."""
    path = Path(path)
    rest_count = 3 * (scene.sh.shape[1] - 1)
    names = [*_POSITION, "nx", "ny", "nz", *_COLOR, *(f"f_rest_{i}" for i in range(rest_count)), *_SHAPE]
    # Channel-major: all coefficients of red, then of green, then of blue.
    rest = scene.sh[:, 1:].transpose(1, 2).reshape(scene.count, rest_count)
    normals = torch.zeros_like(scene.means)
    columns = [scene.means, normals, scene.sh[:, 0], rest, scene.opacity_logits[:, None], scene.log_scales, scene.quats]
    body = torch.cat([c.detach().cpu().float() for c in columns], dim=1).numpy().astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {scene.count}"]
    header += [f"property float {n}" for n in names] + ["end_header", ""]
    with replacing(path) as temporary:
        temporary.write_bytes("\n".join(header).encode("ascii") + body.tobytes())
        if masks:
            save_masks(scene, masks_path(path))


def save_masks(scene: GaussianScene, path: Path | str) -> None:
    """Writes simulated, pinned, foreground (bool) and volume_scale as npz without pickles; replaces atomically."""
    masks = {name: getattr(scene, name).cpu().numpy() for name in MASK_NAMES}
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, volume_scale=np.float64(scene.volume_scale), **masks)


def load_masks(scene: GaussianScene, path: Path | str) -> GaussianScene:
    """The scene with the masks and the volume constant of a side file.

    Raises:
        SceneError: naming the file and the mask that is missing, of another length or not boolean.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"{path}: no such file. Expected masks written by `gausim inspect SCENE --save-masks`.")
    try:
        stored = read_npz(path)
    except ValueError as error:
        raise SceneError(f"{path}: not a readable npz of plain arrays ({error}). Write the masks again.") from error
    values: dict[str, Any] = {}
    for n in MASK_NAMES:
        found = stored.get(n)
        if found is None or found.shape != (scene.count,) or found.dtype != np.bool_:
            actual = "none" if found is None else f"{found.dtype} {tuple(found.shape)}"
            raise SceneError(
                f"{path}: mask '{n}': expected bool ({scene.count},) for the Gaussians of '{scene.name}', got {actual}"
                ". Write the masks again with `gausim inspect SCENE --save-masks`, or delete the file."
            )
        values[n] = torch.from_numpy(found)
    scale = stored.get("volume_scale", np.zeros(0))
    if scale.shape != () or not np.isfinite(scale) or scale <= 0:
        raise SceneError(f"{path}: field 'volume_scale': expected one positive number, got {scale!r}.")
    try:
        return replace(scene, volume_scale=float(scale), **values).validated()
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error


def _rest_names(path: Path, names: tuple[str, ...]) -> list[str]:
    """The f_rest properties in order, after checking that all properties of 3DGS exist."""
    count = sum(n.startswith("f_rest_") for n in names)
    if count not in _REST_COUNTS:
        raise SceneError(
            f"{path}: {count} properties 'f_rest_*'; expected 0, 9, 24 or 45 (SH degree 0, 1, 2 or 3). Export again."
        )
    rest = [f"f_rest_{i}" for i in range(count)]
    missing = [n for n in (*_POSITION, *_COLOR, *_SHAPE, *rest) if n not in names]
    if missing == ["scale_2"]:
        raise SceneError(
            f"{path}: property 'scale_2' is missing: these are flat splats (2DGS). Train the scene as 3DGS, e.g. with "
            "`gausim reconstruct`."
        )
    if missing:
        raise SceneError(
            f"{path}: property '{missing[0]}' is missing (missing in all: {', '.join(missing)}). Expected a 3DGS PLY; "
            "a plain point cloud or mesh must be reconstructed first (`gausim reconstruct`)."
        )
    return rest


def _check_extent(path: Path, table: np.ndarray) -> None:
    """Raises a :class:`SceneError` where float32 cannot hold the positions or variances, as in UTM or micrometres."""
    x = structured_to_unstructured(table[list(_POSITION)], np.float64)
    if not (np.abs(x) < np.finfo(np.float32).max).all():
        return  # refused by name later
    low, high = np.quantile(x, 0.01, axis=0), np.quantile(x, 0.99, axis=0)
    far = np.abs(np.stack([low, high])).max()
    extent = np.linalg.norm(high - low)
    step = float(np.spacing(np.float32(far)))
    if step > COARSEST_STEP * extent and extent > 0:
        center = ", ".join(f"{value:.0f}" for value in np.round((low + high) / 2))
        raise SceneError(
            f"{path}: positions lie around ({center}), {far / extent:.3g} times the scene's extent from the origin: "
            f"float32 has steps of {step:.2g} there. Subtract ({center}) from x, y, z and from the camera positions, "
            "and export again."
        )
    if extent > 0 and not LEAST_EXTENT <= extent <= MOST_EXTENT:
        factor = 10.0 ** -round(np.log10(extent))
        raise SceneError(
            f"{path}: the scene spans {extent:.2g} units; float32 computes well between {LEAST_EXTENT:g} and "
            f"{MOST_EXTENT:g}. Multiply positions and camera positions by {factor:g}, add {np.log(factor):.4f} to "
            "scale_0, scale_1 and scale_2, and export again."
        )


def _columns(path: Path, table: np.ndarray, names: list[str]) -> np.ndarray:
    """These properties of all vertices, (K, n) float32, all finite."""
    # Doubles beyond float32 overflow to infinity, which the check below reports instead of a warning.
    with np.errstate(over="ignore"):
        values = structured_to_unstructured(table[names], np.float32)
    bad = ~np.isfinite(values)
    if bad.any():
        column = int(bad.any(0).argmax())
        raise SceneError(
            f"{path}: property '{names[column]}' is NaN or infinite for {int(bad[:, column].sum())} of {len(bad)} "
            f"vertices (first: vertex {int(bad[:, column].argmax())}); expected finite numbers. Remove them or repair "
            "the reconstruction."
        )
    return values


def _read_vertices(path: Path) -> np.ndarray:
    """The table of the vertices, which have to be the first element; a compressed PLY is decompressed."""
    if path.suffix.lower() in OTHER_FORMATS:
        raise SceneError(
            f"{path}: {path.suffix} is no PLY file. Open it in SuperSplat and export it as PLY, or convert it with "
            f"`npx @playcanvas/splat-transform {path.name} {path.stem}.ply`."
        )
    try:
        ply = read_ply(path)
    except DataError as error:
        raise SceneError(str(error)) from error
    elements = ply.elements
    if is_compressed(ply):
        return decompressed(ply, str(path))
    if not elements or elements[0].name != "vertex":
        found = f"'{elements[0].name}'" if elements else "none"
        raise SceneError(f"{path}: first element must be 'vertex', got {found}. Expected a 3DGS scene.")
    lists = [p.name for p in elements[0].properties if isinstance(p, PlyListProperty)]
    if elements[0].count == 0 or lists:
        what = f"property '{lists[0]}' is a list" if lists else "is empty"
        raise SceneError(f"{path}: element 'vertex': {what}. Export the file as a 3DGS scene.")
    return np.asarray(elements[0].data)
