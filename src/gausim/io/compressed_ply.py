"""Compressed PLY of SuperSplat and PlayCanvas: 256 Gaussians share a chunk with the bounds of their packed values."""

import numpy as np
from jaxtyping import Float, UInt32
from numpy.lib.recfunctions import structured_to_unstructured
from plyfile import PlyData

from gausim.core.errors import SceneError

CHUNK = 256
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
# Spherical harmonics of order 0, which turns a colour to its coefficient.
SH_0 = 0.28209479177387814
_BOUNDS = [f"{end}_{prefix}{axis}" for prefix in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
_COLORS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]


def is_compressed(ply: PlyData) -> bool:
    """Whether a PLY file has the elements of a compressed scene."""
    return {"chunk", "vertex"} <= {element.name for element in ply.elements} and set(PACKED) <= {
        each.name for each in ply["vertex"].properties
    }


def decompressed(ply: PlyData, name: str) -> np.ndarray:
    """The table of vertices, with the properties of 3DGS in float32.

    Opacities of exactly 0 and 1 become those half a step of their 8 bits away, whose logits are finite.

    Raises:
        SceneError: elements have counts that do not match, or bounds are missing.
    """
    vertices, chunks = ply["vertex"].data, ply["chunk"].data
    count, needed = len(vertices), -(-len(vertices) // CHUNK)
    missing = [each for each in _BOUNDS if each not in (chunks.dtype.names or ())]
    if len(chunks) != needed or missing:
        found = f"property '{missing[0]}' is missing" if missing else f"has {len(chunks)} chunks"
        raise SceneError(
            f"{name}: compressed PLY: {found}; expected {needed} chunks for {count} Gaussians. Export again."
        )
    row = np.arange(count) // CHUNK
    bounds = structured_to_unstructured(chunks[_BOUNDS], np.float64)[row].reshape(count, 2, 2, 3)
    position, rotation, scale, color = (np.asarray(vertices[each], np.uint32) for each in PACKED)
    rgba = np.stack([_unit(color, shift, 8) for shift in (24, 16, 8, 0)], 1)
    if set(_COLORS) <= set(chunks.dtype.names or ()):
        low, high = structured_to_unstructured(chunks[_COLORS], np.float64)[row].reshape(count, 2, 3).swapaxes(0, 1)
        rgba[:, :3] = low + rgba[:, :3] * (high - low)
    alpha = rgba[:, 3].clip(0.5 / 255, 1 - 0.5 / 255)
    columns = {
        **_named("xyz", _between(bounds[:, 0], position)),
        **_named([f"f_dc_{i}" for i in range(3)], (rgba[:, :3] - 0.5) / SH_0),
        "opacity": np.log(alpha / (1 - alpha)),
        **_named([f"scale_{i}" for i in range(3)], _between(bounds[:, 1], scale)),
        **_named([f"rot_{i}" for i in range(4)], _quaternions(rotation)),
        **_harmonics(ply, count, name),
    }
    table = np.empty(count, dtype=[(each, np.float32) for each in columns])
    for each, values in columns.items():
        table[each] = values
    return table


def _unit(packed: UInt32[np.ndarray, " K"], shift: int, bits: int) -> Float[np.ndarray, " K"]:
    most = (1 << bits) - 1
    return np.asarray((packed >> np.uint32(shift) & np.uint32(most)) / most)


def _between(bounds: Float[np.ndarray, "K 2 3"], packed: UInt32[np.ndarray, " K"]) -> Float[np.ndarray, "K 3"]:
    """Values of 11, 10 and 11 bits as fractions between the bounds of their chunk."""
    part = np.stack([_unit(packed, 21, 11), _unit(packed, 11, 10), _unit(packed, 0, 11)], 1)
    return np.asarray(bounds[:, 0] * (1 - part) + bounds[:, 1] * part)


def _quaternions(packed: UInt32[np.ndarray, " K"]) -> Float[np.ndarray, "K 4"]:
    """Quaternions w x y z: two bits name the largest component, left out; the others have 10 bits each."""
    rest = (np.stack([_unit(packed, shift, 10) for shift in (20, 10, 0)], 1) - 0.5) * np.sqrt(2)
    largest = np.sqrt((1 - (rest**2).sum(1)).clip(0))
    place = (packed >> np.uint32(30)).astype(np.int64)
    quats = np.empty((len(packed), 4))
    quats[np.arange(len(packed)), place] = largest
    others = np.arange(4) != place[:, None]
    quats[others] = rest.reshape(-1)
    return quats


def _harmonics(ply: PlyData, count: int, name: str) -> dict[str, np.ndarray]:
    if "sh" not in {element.name for element in ply.elements}:
        return {}
    table = ply["sh"].data
    if len(table) != count:
        raise SceneError(
            f"{name}: compressed PLY: element 'sh' has {len(table)} rows for {count} Gaussians. Export again."
        )
    coefficients = {}
    for number, each in enumerate(table.dtype.names or ()):
        stored = table[each].astype(np.float64)
        unit = np.where(stored == 0, 0.0, np.where(stored == 255, 1.0, (stored + 0.5) / 256))
        coefficients[f"f_rest_{number}"] = (unit - 0.5) * 8
    return coefficients


def _named(names: str | list[str], values: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[:, i] for i, name in enumerate(names)}
