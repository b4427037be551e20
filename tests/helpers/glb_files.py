"""Binary glTF files, read as their documentation describes them."""

import json
import struct
from pathlib import Path

import numpy as np
import torch

from gausim.core import GaussianScene
from gausim.io.gltf import EXTENSION


class GlbFile:
    """The two parts of a file."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, length, size = struct.unpack_from("<4sIII", data)
        assert magic == b"glTF" and version == 2 and length == len(data)
        self.document, self.binary = json.loads(data[20 : 20 + size]), data[28 + size :]

    def view(self, index: int, kind: str) -> np.ndarray:
        view = self.document["bufferViews"][index]
        return np.frombuffer(self.binary, kind, view["byteLength"] // np.dtype(kind).itemsize, view["byteOffset"])

    def attribute(self, name: str) -> torch.Tensor:
        index = self.document["meshes"][0]["primitives"][0]["attributes"][name]
        accessor = self.document["accessors"][index]
        return torch.from_numpy(self.view(accessor["bufferView"], "<f4").reshape(accessor["count"], -1).copy())

    def check_splats(self, scene: GaussianScene, degree: int | None = None) -> None:
        """Compares the Gaussians with those of a scene."""
        assert torch.equal(self.attribute("POSITION"), scene.means)
        quats = scene.quats / scene.quats.norm(dim=-1, keepdim=True)
        assert torch.allclose(self.attribute(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]], quats, atol=1e-7)
        assert torch.allclose(self.attribute(f"{EXTENSION}:SCALE").log(), scene.log_scales, atol=1e-6)
        opacities = self.attribute(f"{EXTENSION}:OPACITY")[:, 0]
        assert torch.allclose(opacities, scene.opacity_logits.sigmoid(), atol=1e-6)
        degrees = range((scene.sh_degree if degree is None else degree) + 1)
        names = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in degrees for n in range(2 * d + 1)]
        assert torch.equal(torch.stack([self.attribute(name) for name in names], 1), scene.sh[:, : len(names)])
