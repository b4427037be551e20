"""What is picked: an octahedron at every part that catches the pointer and draws nothing, not even into the depth."""

from __future__ import annotations

import json
import struct

import numpy as np

_CORNERS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], "<f4")
_FACES = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], "<u2")
# glTF's numbers of types and of buffers' uses.
_FLOAT, _USHORT, _VERTICES, _INDICES = 5126, 5123, 34962, 34963


def invisible_octahedron() -> bytes:
    """A binary glTF of a transparent unit octahedron.

    A mesh of opacity 0 still hides the splats behind it, which are drawn last and tested against the depth; glTF
    materials that blend are loaded as ones that leave the depth alone.
    """
    data = _CORNERS.tobytes() + _FACES.tobytes()
    material = {"alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0]}, "doubleSided": True}
    scene = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [material],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": _FLOAT, "count": 6, "type": "VEC3", "min": [-1] * 3, "max": [1] * 3},
            {"bufferView": 1, "componentType": _USHORT, "count": _FACES.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": _CORNERS.nbytes, "target": _VERTICES},
            {"buffer": 0, "byteOffset": _CORNERS.nbytes, "byteLength": _FACES.nbytes, "target": _INDICES},
        ],
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
