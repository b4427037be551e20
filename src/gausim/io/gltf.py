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

from gausim.core import DataError, GaussianScene
from gausim.io.files import write_durably
from gausim.ops.spherical_harmonics import C0

EXTENSION = "KHR_gaussian_splatting"
_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"
_FLOAT, _BYTE, _ARRAY_BUFFER, _POINTS = 5126, 5121, 34962, 0
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
# Turns z up to y up: -90 degrees about x, as quaternion x y z w.
_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
_LARGEST = 4 << 30  # the lengths in the file have 32 bits


@dataclass
class Glb:
    """A document of glTF and its binary part."""

    document: dict[str, Any]  # the JSON part
    binary: bytearray = field(default_factory=bytearray)  # the bytes that its buffer views name

    def add_view(self, array: np.ndarray, **more: int) -> int:
        """Appends an array as a buffer view that begins at a multiple of four bytes; returns its index."""
        data, views = np.ascontiguousarray(array).tobytes(), self.document.setdefault("bufferViews", [])
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


def save_gltf_frames(folder: Path | str, name: str, frames: Iterable[GaussianScene], *, up: str = "z") -> int:
    """Writes one GLB per frame, NAME_0001.glb first; replaces existing files. Returns the number of frames."""
    number = 0
    for number, scene in enumerate(frames, start=1):
        write_durably(Path(folder) / f"{name}_{number:04d}.glb", splat_glb(scene, up=up).to_bytes())
    return number


def _sh_names(degree: int) -> list[str]:
    return [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]


def contiguous(value: torch.Tensor) -> np.ndarray:
    """The values as a contiguous array of float32."""
    return np.ascontiguousarray(value.detach().cpu().float().numpy())
