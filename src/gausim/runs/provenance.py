"""Provenance of results: commit of this package and hashes of the data, stored with every evaluation."""

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

import gausim
from gausim.data.objects import ObjectData
from gausim.io.files import sha256

PACKAGE = Path(gausim.__file__).resolve().parent
# The manifest of a store has more content than ``dataset.json``; the first existing file is used.
MANIFESTS = ("manifest.json", "dataset.json")


def code_provenance(package: Path = PACKAGE) -> dict[str, Any]:
    """Versions, and the git commit where the package is part of a checkout (else null).

    Returns:
        ``gausim``, ``torch``, ``python``: versions; ``machine``: processor and GPU; ``commit``; ``modified``: whether
        tracked files of the package differ from the commit.
    """
    versions = {"gausim": gausim.__version__, "torch": str(str(torch.__version__)), "python": platform.python_version()}
    # A package installed inside another project's checkout is not tracked by that repository.
    tracked = _git(package, "ls-files", "--error-unmatch", "__init__.py") is not None
    commit = _git(package, "rev-parse", "HEAD") if tracked else None
    status = _git(package, "status", "--porcelain", "--untracked-files=no", "--", ".") if commit else None
    modified = None if status is None else bool(status)
    return {**versions, "machine": machine(), "commit": commit, "modified": modified}


def machine() -> str:
    """Processor with its number of cores, and the GPU in use, if any."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    processor = f"{next(named, platform.processor() or platform.machine())}, {os.cpu_count()} cores"
    return f"{torch.cuda.get_device_name()}, {processor}" if torch.cuda.is_initialized() else processor


def data_provenance(data: ObjectData) -> dict[str, Any]:
    """Names and SHA-256 of an object's rest scene, its masks and its manifest (null for missing files)."""
    manifests = [data.root / name for name in MANIFESTS]
    manifest = next((path for path in manifests if path.is_file()), manifests[-1])
    masks = data.masks_path or data.scene_path.with_suffix(".masks.npz")
    files = {"scene": data.scene_path, "masks": masks, "manifest": manifest}
    hashes = {key: {"file": p.name, "sha256": sha256(p) if p.is_file() else None} for key, p in files.items()}
    return {"root": str(data.root), **hashes}


def _git(folder: Path, *arguments: str) -> str | None:
    """Output of git, or None without git, without a repository or on an error."""
    command = ["git", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
