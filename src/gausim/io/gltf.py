"""Gaussians as glTF 2.0 in one binary file (GLB), by the ratified extension KHR_gaussian_splatting.

Every value is float32: positions, unit quaternions x y z w, linear scales, opacities in [0, 1], spherical harmonics.
A node turns a scene whose z points up to glTF's axes, in which y does; the Gaussians themselves keep their numbers.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gausim.core import DataError, GaussianScene, SceneError
from gausim.core.scene import SH_COEFFICIENTS
from gausim.io.files import write_durably
from gausim.io.plain_json import parse_json
from gausim.ops.spherical_harmonics import C0

EXTENSION = "KHR_gaussian_splatting"
_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"
_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
# Turns z up to y up: -90 degrees about x, as quaternion x y z w.
_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
# Opacities closer to 0 or 1 than this have no finite logit in float32.
_EDGE = 1e-7
_LARGEST = 4 << 30  # the lengths in the file have 32 bits
_REMEDY = "Export it again with `gausim export`."


@dataclass
class Glb:
    """A document of glTF and its binary part, to be written or as read."""

    document: dict[str, Any]  # the JSON part
    binary: bytearray | bytes = field(default_factory=bytearray)  # the bytes that its buffer views name
    source: str = ""  # the file that it was read from, for messages

    def add_view(self, array: np.ndarray, **more: int) -> int:
        """Appends an array as a buffer view that begins at a multiple of four bytes; returns its index."""
        data, views = np.ascontiguousarray(array).tobytes(), self.document.setdefault("bufferViews", [])
        assert isinstance(self.binary, bytearray)
        views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data), **more})
        self.binary += data + bytes(-len(data) % 4)
        self.document["buffers"] = [{"byteLength": len(self.binary)}]
        return len(views) - 1

    def add_attribute(self, array: np.ndarray) -> int:
        """Appends one row per Gaussian as an accessor, float32 or bytes that stand for 0..1; returns its index."""
        rows = array.reshape(len(array), -1)
        kind = next(name for name, width in _WIDTHS.items() if width == rows.shape[1])
        view = self.add_view(array, target=_ARRAY_BUFFER)
        accessor: dict[str, Any] = {"bufferView": view, "count": len(rows), "type": kind, "componentType": _FLOAT}
        if array.dtype == np.uint8:
            accessor |= {"componentType": _BYTE, "normalized": True}
        else:
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.document.setdefault("accessors", []).append(accessor)
        return len(self.document["accessors"]) - 1

    def to_bytes(self) -> bytes:
        """The file: a header, the JSON part and the binary part.

        Raises:
            DataError: it would be larger than the format allows.
        """
        text = json.dumps(self.document, allow_nan=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        size = 28 + len(text) + len(self.binary)
        if size >= _LARGEST:
            raise DataError(
                f"glTF: {size} bytes, expected less than {_LARGEST >> 30} GiB. Take fewer frames (--every)."
            )
        head = _MAGIC + struct.pack("<III", 2, size, len(text)) + _JSON
        return head + text + struct.pack("<I", len(self.binary)) + _BINARY + bytes(self.binary)

    def view(self, index: Any, name: str) -> memoryview:
        """The bytes of a buffer view.

        Raises:
            DataError: there is no such view, or it lies outside of the binary part; names the field.
        """
        view = self.entry("bufferViews", index, name)
        start, length = view.get("byteOffset", 0), view.get("byteLength")
        inside = all(type(n) is int and n >= 0 for n in (start, length)) and start + length <= len(self.binary)
        if not inside or view.get("buffer") != 0 or "byteStride" in view:
            raise DataError(
                f"{self.source}: bufferViews[{index}] of '{name}': expected a part of the {len(self.binary)} bytes of "
                f"buffer 0 without a stride, got {json.dumps(view)[:200]}. {_REMEDY}"
            )
        return memoryview(self.binary)[start : start + length]

    def attribute(self, index: Any, name: str, *, width: int, count: int | None = None) -> np.ndarray:
        """The rows of an accessor, float32 (count, width) and finite.

        Raises:
            DataError: it is missing, of another type or length, or holds NaN or infinity; names the attribute.
        """
        accessor = self.entry("accessors", index, name)
        kinds = accessor.get("componentType"), _WIDTHS.get(str(accessor.get("type")))
        data = self.view(accessor.get("bufferView"), name)
        rows = accessor.get("count") if count is None else count
        held = accessor.get("count") == rows and type(rows) is int and rows > 0 and len(data) == 4 * width * rows
        if kinds != (_FLOAT, width) or not held or "sparse" in accessor or accessor.get("byteOffset", 0) != 0:
            raise DataError(
                f"{self.source}: attribute '{name}': expected {rows} rows of {width} float32, got "
                f"{json.dumps(accessor)[:200]} of {len(data)} bytes. {_REMEDY}"
            )
        values = np.frombuffer(data, "<f4").reshape(-1, width)
        if not np.isfinite(values).all():
            raise DataError(f"{self.source}: attribute '{name}' is NaN or infinite. {_REMEDY}")
        return values

    def entry(self, kind: str, index: Any, name: str) -> dict[str, Any]:
        """An object of a list of the document by its index.

        Raises:
            DataError: there is none; names ``name``, the field that gave the index.
        """
        entries = self.document.get(kind)
        entries = entries if isinstance(entries, list) else []
        if type(index) is not int or not 0 <= index < len(entries) or not isinstance(entries[index], dict):
            raise DataError(
                f"{self.source}: field '{name}': expected an index of {len(entries)} {kind}, got {str(index)[:40]}. "
                f"{_REMEDY}"
            )
        found: dict[str, Any] = entries[index]
        return found


def read_glb(path: Path | str) -> Glb:
    """Reads the two parts of a binary glTF file; nothing that it may name elsewhere is opened.

    Raises:
        DataError: the file is missing, is not a GLB of version 2, or is cut off.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            data = file.read() if size < _LARGEST else b""
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}). Write one with `gausim export`.") from None
    if data[:4] != _MAGIC or len(data) < 28 or struct.unpack_from("<I", data, 4) != (2,):
        raise DataError(f"{path}: expected a binary glTF 2.0 file, got {data[:8]!r}. Check the file format.")
    length, text_size = struct.unpack_from("<II", data, 8)
    end = 20 + text_size
    kinds = data[16:20], data[end + 4 : end + 8]
    if length != len(data) or kinds != (_JSON, _BINARY) or struct.unpack_from("<I", data, end) != (length - end - 8,):
        raise DataError(f"{path}: expected {length} bytes, a JSON and a binary part, got {len(data)} bytes. {_REMEDY}")
    try:
        document = parse_json(data[20:end])
    except ValueError as error:
        raise DataError(f"{path}: the JSON part cannot be read ({error}). {_REMEDY}") from error
    if not isinstance(document, dict):
        raise DataError(f"{path}: the JSON part: expected an object, got {str(document)[:40]}. {_REMEDY}")
    return Glb(document, data[end + 8 :], str(path))


def splat_glb(scene: GaussianScene, *, up: str = "z", degree: int | None = None) -> Glb:
    """The document of a scene; spherical harmonics up to ``degree``, by default all."""
    glb = Glb({"asset": {"version": "2.0", "generator": "gausim"}, "extensionsUsed": [EXTENSION]})
    opacities, sh = torch.sigmoid(scene.opacity_logits), contiguous(scene.sh)
    base = contiguous(torch.cat(((C0 * scene.sh[:, 0] + 0.5).clamp(0, 1), opacities[:, None]), 1))
    quats = scene.quats / scene.quats.norm(dim=-1, keepdim=True)
    attributes = {
        "POSITION": contiguous(scene.means),
        "COLOR_0": (255 * base + 0.5).astype(np.uint8),  # for readers that know points only
        f"{EXTENSION}:ROTATION": contiguous(quats[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": contiguous(scene.log_scales.exp()),
        f"{EXTENSION}:OPACITY": contiguous(opacities),
    }
    attributes |= {name: sh[:, i] for i, name in enumerate(_sh_names(scene.sh_degree if degree is None else degree))}
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
              "sortingMethod": "cameraDistance"}  # fmt: skip
    primitive = {
        "mode": _POINTS,
        "attributes": {name: glb.add_attribute(array) for name, array in attributes.items()},
        "extensions": {EXTENSION: kernel},
    }
    turned = {"rotation": _Z_UP} if up == "z" else {}
    glb.document |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": scene.name, "mesh": 0, **turned}],
        "meshes": [{"name": scene.name, "primitives": [primitive]}],
    }
    return glb


def splat_scene(glb: Glb, name: str) -> GaussianScene:
    """The Gaussians of a document with one primitive, as :func:`splat_glb` makes it.

    Raises:
        DataError: an attribute is missing, malformed or out of range; names it.
    """
    attributes = _attributes(glb)
    means = glb.attribute(attributes.get("POSITION"), "POSITION", width=3)
    count = len(means)

    def read(short: str, width: int) -> np.ndarray:
        key = f"{EXTENSION}:{short}"
        return glb.attribute(attributes.get(key), key, width=width, count=count)

    quats, scales, opacities = read("ROTATION", 4), read("SCALE", 3), read("OPACITY", 1)[:, 0]
    ranges = (("SCALE", (scales > 0).all(), "> 0"), ("OPACITY", ((opacities >= 0) & (opacities <= 1)).all(), "in 0..1"))
    for short, holds, expected in ranges:
        if not holds:
            raise DataError(f"{glb.source}: attribute '{EXTENSION}:{short}': expected numbers {expected}. {_REMEDY}")
    degree = max((d for d in SH_COEFFICIENTS if set(_sh_names(d)) <= set(attributes)), default=0)
    sh = np.stack([glb.attribute(attributes.get(n), n, width=3, count=count) for n in _sh_names(degree)], 1)
    try:
        return linear_scene(means, scales, quats, opacities, sh, name)
    except SceneError as error:
        raise DataError(f"{glb.source}: {error}") from error


def linear_scene(
    means: np.ndarray, scales: np.ndarray, quats: np.ndarray, opacities: np.ndarray, sh: np.ndarray, name: str
) -> GaussianScene:
    """A scene of linear scales, quaternions x y z w and opacities in [0, 1], as glTF and USD hold them."""
    return GaussianScene.create(
        means=torch.from_numpy(means.copy()),
        log_scales=torch.from_numpy(scales.copy()).log(),
        quats=torch.from_numpy(np.ascontiguousarray(quats[:, [3, 0, 1, 2]])),
        opacity_logits=torch.from_numpy(opacities.astype(np.float64)).logit(_EDGE).float(),
        sh=torch.from_numpy(sh),
        name=name,
    )


def save_gltf_frames(folder: Path | str, name: str, frames: Iterable[GaussianScene], *, up: str = "z") -> int:
    """Writes one GLB per frame, NAME_0001.glb first; replaces existing files. Returns the number of frames."""
    number = 0
    for number, scene in enumerate(frames, start=1):
        write_durably(Path(folder) / f"{name}_{number:04d}.glb", splat_glb(scene, up=up).to_bytes())
    return number


def _attributes(glb: Glb) -> dict[str, Any]:
    meshes = glb.document.get("meshes")
    primitives = [p for p in _objects(meshes) for p in _objects(p.get("primitives"))]
    ours = [p for p in primitives if isinstance(p.get("extensions"), dict) and EXTENSION in p["extensions"]]
    if len(ours) != 1 or not isinstance(ours[0].get("attributes"), dict):
        raise DataError(
            f"{glb.source}: field 'meshes': expected one primitive of Gaussians ({EXTENSION}) with attributes, got "
            f"{len(ours)}. {_REMEDY}"
        )
    found: dict[str, Any] = ours[0]["attributes"]
    return found


def _objects(value: Any) -> list[dict[str, Any]]:
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def _sh_names(degree: int) -> list[str]:
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]


def contiguous(value: torch.Tensor) -> np.ndarray:
    """The values as a contiguous array of float32."""
    return np.ascontiguousarray(value.detach().cpu().float().numpy())
