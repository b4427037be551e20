"""A reconstruction on the way, on disk, so that the same command goes on where it was interrupted."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from gausim.io.files import write_durably
from gausim.reconstruction.reconstruction import ReconstructionOptions
from gausim.reconstruction.splat_start import PointCloud
from gausim.reconstruction.stills import ImageSet

# Raise when the same arguments give another reconstruction than before.
REVISION = 1


def identity(sets: Sequence[ImageSet], options: ReconstructionOptions, cloud: PointCloud | None) -> str:
    """SHA-256 of everything that a reconstruction depends on: images, cameras, options and points."""
    digest = hashlib.sha256(json.dumps([REVISION, asdict(options)], sort_keys=True).encode())
    tensors = [x for s in sets for x in (s.images, s.cameras.viewmats, s.cameras.Ks)]
    if cloud is not None:
        tensors += [cloud.points] if cloud.colors is None else [cloud.points, cloud.colors]
    for tensor in tensors:
        digest.update(repr((tensor.dtype, tuple(tensor.shape))).encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    for images in sets:
        digest.update(repr((images.share, images.span, images.cameras.width, images.cameras.height)).encode())
    return digest.hexdigest()


class Partial:
    """The file of an unfinished reconstruction, beside the scene that it will write."""

    def __init__(self, scene: Path, key: str) -> None:
        """Names the file of the scene that is being made; ``key`` is the :func:`identity` of its reconstruction."""
        self.path, self._key = scene.with_name(f".{scene.name}.partial"), key

    def read(self) -> dict[str, Tensor] | None:
        """What an interrupted reconstruction of the same arguments left; None where there is nothing of use."""
        try:
            with safe_open(str(self.path), framework="pt") as file:
                if (file.metadata() or {}).get("key") != self._key:
                    return None
                return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
        except (OSError, SafetensorError):
            return None

    def write(self, state: dict[str, Tensor]) -> None:
        """Replaces the file."""
        tensors = {name: value.contiguous() for name, value in state.items()}
        write_durably(self.path, save(tensors, metadata={"key": self._key}))

    def remove(self) -> None:
        """The scene is there: the file is not needed any more."""
        self.path.unlink(missing_ok=True)
