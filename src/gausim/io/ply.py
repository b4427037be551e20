"""Gaussian scenes as 3DGS PLY files (INRIA layout) with a side file of masks.

The PLY holds what every 3DGS viewer reads; what the dynamics needs besides (masks and the volume constant) lies in
``<stem>.masks.npz`` next to it, so that the PLY itself stays readable everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gausim.core.errors import SceneError
from gausim.core.scene import GaussianScene
from gausim.io.files import replacing
from gausim.io.npz import read_npz

MASK_SUFFIX = ".masks.npz"
MASK_NAMES = ("simulated", "pinned", "foreground")

# Names of the PLY specification and the ones that later writers use for the same types.
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_BYTE_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
# f_rest holds (d + 1)^2 - 1 coefficients for each of three channels.
_REST_COUNTS = {0: 0, 9: 1, 24: 2, 45: 3}
_REQUIRED = (
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
    "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip
# No header of a Gaussian scene comes near this; a binary file without end_header must not be read whole as text.
_HEADER_LIMIT = 1 << 16


@dataclass(frozen=True)
class _Header:
    """What a PLY header declares about its vertices, and where their data starts [bytes]."""

    encoding: str
    count: int
    dtype: np.dtype
    offset: int
    only_element: bool


def masks_path(path: Path | str) -> Path:
    """The side file of a scene: ``scene.ply`` -> ``scene.masks.npz``."""
    path = Path(path)
    return path.with_name(path.stem + MASK_SUFFIX)


def load_scene(path: Path | str, *, masks: Path | str | None = None, name: str | None = None) -> GaussianScene:
    """Reads a 3DGS PLY with SH degree 0..3 in any property order, as little endian, big endian or text.

    Normals and properties that 3DGS does not know are skipped; doubles are rounded to float32.

    Args:
        path: the PLY file.
        masks: its masks; without it ``<stem>.masks.npz`` is used if it lies next to the PLY, and otherwise every
            kernel is simulated and foreground and none is pinned.
        name: name of the scene in messages and checkpoints, default the file's stem.

    Raises:
        SceneError: naming the file and the property that is missing, malformed, NaN, infinite or a zero quaternion.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"{path}: no such file. Expected a 3DGS scene in PLY format.")
    table = _read_vertices(path)
    rest = _rest_names(path, table.dtype.names or ())
    values = {n: _finite_column(path, table, n) for n in (*_REQUIRED, *rest)}
    quats = _stack(values, [f"rot_{i}" for i in range(4)])
    zero = (quats == 0).all(-1)
    if zero.any():
        raise SceneError(
            f"{path}: properties 'rot_0'..'rot_3' are all zero for {int(zero.sum())} of {len(zero)} vertices "
            f"(first: vertex {int(zero.nonzero()[0])}); expected a non-zero quaternion. Remove them or export again."
        )
    try:
        scene = GaussianScene.create(
            means=_stack(values, ["x", "y", "z"]),
            log_scales=_stack(values, [f"scale_{i}" for i in range(3)]),
            quats=quats,
            opacity_logits=torch.from_numpy(values["opacity"]),
            sh=_sh_from_columns(values, rest),
            name=path.stem if name is None else name,
        )
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error
    side = masks_path(path) if masks is None else Path(masks)
    return load_masks(scene, side) if masks is not None or side.is_file() else scene


def load_points(path: Path | str) -> np.ndarray:
    """Positions (P, 3) float32 of a PLY's vertices, whatever else they have (point clouds, meshes, scenes).

    Raises:
        SceneError: naming the file and the property that is missing, malformed, NaN or infinite.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(f"{path}: no such file. Expected a point cloud in PLY format.")
    table = _read_vertices(path)
    missing = [n for n in ("x", "y", "z") if n not in (table.dtype.names or ())]
    if missing:
        raise SceneError(f"{path}: property '{missing[0]}' is missing. Expected points with x, y and z.")
    return np.stack([_finite_column(path, table, n) for n in ("x", "y", "z")], axis=-1)


def save_scene(scene: GaussianScene, path: Path | str, *, masks: bool = True) -> None:
    """Writes the scene as little-endian float32 PLY in INRIA order, and its masks next to it; replaces atomically.

    Args:
        scene: what to write.
        path: the PLY file.
        masks: write ``<stem>.masks.npz``, too.
    """
    path = Path(path)
    rest_count = 3 * (scene.sh.shape[1] - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(rest_count)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
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
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            volume_scale=np.float64(scene.volume_scale),
            simulated=scene.simulated.cpu().numpy(),
            pinned=scene.pinned.cpu().numpy(),
            foreground=scene.foreground.cpu().numpy(),
        )


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
    values: dict[str, Tensor] = {}
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
    return GaussianScene.create(
        means=scene.means,
        log_scales=scene.log_scales,
        quats=scene.quats,
        opacity_logits=scene.opacity_logits,
        sh=scene.sh,
        volume_scale=float(scale),
        name=scene.name,
        **values,
    )


def _stack(values: dict[str, np.ndarray], names: list[str]) -> Tensor:
    return torch.from_numpy(np.stack([values[n] for n in names], axis=-1))


def _sh_from_columns(values: dict[str, np.ndarray], rest: list[str]) -> Tensor:
    dc = _stack(values, ["f_dc_0", "f_dc_1", "f_dc_2"])[:, None]
    if not rest:
        return dc
    high = _stack(values, rest).reshape(dc.shape[0], 3, -1).transpose(1, 2)
    return torch.cat([dc, high], dim=1).contiguous()


def _rest_names(path: Path, names: tuple[str, ...]) -> list[str]:
    """The f_rest properties in order, after checking that nothing 3DGS needs is missing."""
    missing = [n for n in _REQUIRED if n not in names]
    if missing:
        raise SceneError(
            f"{path}: property '{missing[0]}' is missing (missing in all: {', '.join(missing)}). Expected a 3DGS PLY; "
            "a plain point cloud or mesh must be reconstructed first (`gausim reconstruct`)."
        )
    count = sum(n.startswith("f_rest_") for n in names)
    if count not in _REST_COUNTS:
        raise SceneError(
            f"{path}: {count} properties 'f_rest_*'; expected 0, 9, 24 or 45 (SH degree 0, 1, 2 or 3). Export again."
        )
    rest = [f"f_rest_{i}" for i in range(count)]
    absent = [n for n in rest if n not in names]
    if absent:
        raise SceneError(f"{path}: property '{absent[0]}' is missing among {count} 'f_rest_*'. Export again.")
    return rest


def _finite_column(path: Path, table: np.ndarray, name: str) -> np.ndarray:
    # Overflow to infinity of a double beyond float32 is reported by the check below, not by a warning.
    with np.errstate(over="ignore"):
        column = table[name].astype(np.float32)
    bad = ~np.isfinite(column)
    if bad.any():
        raise SceneError(
            f"{path}: property '{name}' is NaN or infinite for {int(bad.sum())} of {len(bad)} vertices "
            f"(first: vertex {int(bad.argmax())}); expected finite numbers. Remove them or repair the reconstruction."
        )
    return column


def _read_vertices(path: Path) -> np.ndarray:
    """The vertex table, after checking that the file holds as many bytes (or lines) as its header promises."""
    header = _read_header(path)
    if header.count == 0:
        raise SceneError(f"{path}: element 'vertex' is empty; expected at least one Gaussian.")
    if header.encoding == "ascii":
        return _read_text(path, header)
    expected = header.count * header.dtype.itemsize
    actual = path.stat().st_size - header.offset
    # Some writers end the file with a line break; a whole vertex too many means that the count is wrong.
    too_long = header.only_element and actual >= expected + header.dtype.itemsize
    if actual < expected or too_long:
        raise SceneError(
            f"{path}: element 'vertex' declares {header.count} vertices of {header.dtype.itemsize} bytes = {expected} "
            f"bytes, but the file holds {actual} bytes of data. It is "
            f"{'not what its header says' if too_long else 'truncated'}; copy or export it again."
        )
    return np.fromfile(path, dtype=header.dtype, count=header.count, offset=header.offset)


def _read_text(path: Path, header: _Header) -> np.ndarray:
    lines = path.read_bytes()[header.offset :].decode("ascii", errors="replace").split("\n")
    rows = [line.split() for line in lines if line.strip()][: header.count]
    width = len(header.dtype.names or ())
    if len(rows) < header.count:
        raise SceneError(
            f"{path}: element 'vertex' declares {header.count} vertices but the file holds {len(rows)} lines of data. "
            "It is truncated; copy or export it again."
        )
    table = np.empty(header.count, dtype=header.dtype)
    for i, row in enumerate(rows):
        try:
            if len(row) != width:
                raise ValueError(f"{len(row)} values")
            table[i] = tuple(float(v) for v in row)
        except ValueError as error:
            raise SceneError(f"{path}: vertex {i}: expected {width} numbers, got {error}. Export it again.") from error
    return table


def _read_header(path: Path) -> _Header:
    with path.open("rb") as file:
        start = file.read(_HEADER_LIMIT)
    if not start.startswith((b"ply\n", b"ply\r\n")):
        raise SceneError(f"{path}: expected a PLY file (first line 'ply'), got {start[:8]!r}. Check the file format.")
    end = start.find(b"end_header")
    stop = start.find(b"\n", end)
    if end < 0 or stop < 0:
        raise SceneError(f"{path}: line 'end_header' is missing. The file is truncated or not a PLY; export it again.")
    lines = [line.split() for line in start[:end].decode("ascii", errors="replace").splitlines()[1:] if line.strip()]
    return _parse_header(path, lines, stop + 1)


def _parse_header(path: Path, lines: list[list[str]], offset: int) -> _Header:
    encoding = ""
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in lines:
        if words[0] == "format" and len(words) == 3 and words[1] in _BYTE_ORDER:
            encoding = words[1]
        elif words[0] == "element" and len(words) == 3 and words[2].isdigit():
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and elements and len(words) >= 3:
            elements[-1][2].append(words[1:])
        elif words[0] not in ("comment", "obj_info"):
            raise SceneError(f"{path}: header line '{' '.join(words)}' is not understood. Export the file again.")
    if not encoding:
        raise SceneError(f"{path}: header line 'format' is missing; expected binary_little_endian 1.0.")
    if not elements or elements[0][0] != "vertex":
        found = ", ".join(e[0] for e in elements) or "none"
        raise SceneError(f"{path}: first element must be 'vertex', got {found}. Expected a 3DGS scene.")
    _, count, properties = elements[0]
    dtype = _vertex_dtype(path, properties, _BYTE_ORDER[encoding])
    return _Header(encoding, count, dtype, offset, len(elements) == 1)


def _vertex_dtype(path: Path, properties: list[list[str]], order: str) -> np.dtype:
    fields: list[tuple[str, str]] = []
    for words in properties:
        if len(words) != 2 or words[0] not in _TYPES:
            raise SceneError(
                f"{path}: property '{words[-1]}' of element 'vertex' has type '{' '.join(words[:-1])}'; "
                f"expected one of {', '.join(_TYPES)}. Export the file as a 3DGS scene."
            )
        if words[1] in [n for n, _ in fields]:
            raise SceneError(f"{path}: property '{words[1]}' of element 'vertex' is declared twice. Export it again.")
        fields.append((words[1], order + _TYPES[words[0]]))
    return np.dtype(fields)
