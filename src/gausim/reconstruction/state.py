"""File of an unfinished reconstruction, from which the same command continues."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from gausim.interaction.session import digest
from gausim.io.files import write_durably
from gausim.reconstruction.reconstruction import ReconstructionOptions
from gausim.reconstruction.splat_start import PointCloud
from gausim.reconstruction.stills import ImageSet

# Increase it when the same arguments give another reconstruction than before.
REVISION = 1


def identity(sets: Sequence[ImageSet], options: ReconstructionOptions, cloud: PointCloud | None) -> str:
    """Digest of the inputs of a reconstruction: images, cameras, options and points."""
    tensors = [x for s in sets for x in (s.images, s.cameras.viewmats, s.cameras.Ks)]
    if cloud is not None:
        tensors += [cloud.points] if cloud.colors is None else [cloud.points, cloud.colors]
    sizes = [(s.weight, s.span, s.cameras.width, s.cameras.height) for s in sets]
    return digest(json.dumps([REVISION, asdict(options), sizes], sort_keys=True), *tensors)


class Partial:
    """The file of an unfinished reconstruction, beside the file of its scene."""

    def __init__(self, scene: Path, key: str) -> None:
        """Path beside the file ``scene``; ``key`` is the :func:`identity` of the reconstruction."""
        self.path, self._key = scene.with_name(f".{scene.name}.partial"), key

    def read(self) -> dict[str, Tensor] | None:
        """State of an interrupted reconstruction with the same arguments; None if there is no such file."""
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
        """Deletes the file, once the scene is written."""
        self.path.unlink(missing_ok=True)
