"""Execution of the stages from film to data set: atomic, resumable, with a manifest of inputs and settings.

A stage reads files and writes one directory. It works in a hidden directory beside it, which takes the final name only
when everything is there, so a directory without ``stage.json`` is never a result. Work that was interrupted goes on
where it was, as long as inputs and settings are the same; each item of it is a file that is written at once
(:func:`gausim.io.files.replacing`).

The function of a stage takes what it reads, ``out`` (the directory of the result), its options, ``overwrite`` (replace
a result of other inputs or settings) and ``tick`` (told of the progress), and returns the manifest.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

import gausim
from gausim.core.errors import DataError
from gausim.io.files import remove_leftovers, replacing, sha256, write_durably, write_json
from gausim.io.plain_json import parse_json

MANIFEST = "stage.json"
PLAN = "plan.json"


@dataclass(frozen=True)
class Stage:
    """One stage with everything that its result depends on."""

    name: str  # of the stage, as in `gausim prepare NAME`
    revision: int  # raised when the same inputs and settings give another result than before
    inputs: Mapping[str, Path]  # files it reads, by the names that the manifest gives them
    settings: Mapping[str, Any]  # everything that was chosen; plain data (as JSON knows it)
    packages: Sequence[str] = ()  # libraries whose versions may matter; recorded, not compared

    def key(self) -> dict[str, Any]:
        """Identity of a result: name and revision of the stage, settings, and the inputs' hashes."""
        settings = json.loads(json.dumps(self.settings))
        inputs = {name: fingerprint(path) for name, path in sorted(self.inputs.items())}
        return {"stage": self.name, "revision": self.revision, "settings": settings, "inputs": inputs}


def run_stage(
    stage: Stage, out: Path, make: Callable[[Path], Mapping[str, Any]], *, overwrite: bool = False
) -> dict[str, Any]:
    """Brings ``out`` to the state that the stage describes, unless it is there already.

    Args:
        stage: with inputs and settings.
        out: directory of the result.
        make: does it in the directory that it is given, where items of an interrupted attempt may lie; returns what is
            worth telling (plain data), which the manifest keeps as ``results``.
        overwrite: replace a result of other inputs or settings.

    Returns:
        The manifest; ``"made"`` (not in the file) tells whether there was anything to do.
    """
    key, old = stage.key(), out.with_name(f".{out.name}.old")
    known = _known(out, key, overwrite=overwrite)
    if known is not None:
        shutil.rmtree(old, ignore_errors=True)  # of a replacement that was killed at its very end
        return {**known, "made": False}
    work = out.with_name(f".{out.name}.{stage.name}.work")
    # Work that is whole, but was killed before it took its name, has a manifest already.
    manifest = read_manifest(work) if (work / MANIFEST).is_file() else {}
    if _different(manifest, key):
        _open_work(work, key)
        try:
            results = json.loads(json.dumps(make(work), allow_nan=False))
        except Exception:
            if not any(path.is_file() and path.name != PLAN for path in work.rglob("*")):
                shutil.rmtree(work, ignore_errors=True)  # there is nothing to go on with
            raise
        manifest = {**key, "versions": _versions(stage.packages), "results": results}
        write_durably(work / MANIFEST, json.dumps(manifest, indent=1, sort_keys=True).encode() + b"\n")
    (work / PLAN).unlink(missing_ok=True)
    shutil.rmtree(old, ignore_errors=True)
    if out.exists():
        os.replace(out, old)
    os.replace(work, out)
    shutil.rmtree(old, ignore_errors=True)
    return {**manifest, "made": True}


def read_manifest(folder: Path, stage: str | None = None) -> dict[str, Any]:
    """The manifest of a finished stage."""
    path = folder / MANIFEST
    if not path.is_file():
        raise DataError(f"{path}: not found. Is this a finished stage? Run `gausim prepare {stage or 'STAGE'}`.")
    try:
        manifest: dict[str, Any] = parse_json(path.read_bytes())
        found = manifest["stage"]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: not the manifest of a stage ({error}). Make it again with --overwrite.") from error
    if stage is not None and found != stage:
        raise DataError(f"{path}: stage is '{found}', expected '{stage}'.")
    return manifest


def fingerprint(path: Path) -> dict[str, Any]:
    """Size and SHA-256 of a file."""
    if not path.is_file():
        raise DataError(f"{path}: not found, or not a file.")
    return {"bytes": path.stat().st_size, "sha256": sha256(path)}


def files_in(work: Path) -> dict[str, Any]:
    """Fingerprints of all files of a stage's work, by name."""
    files = sorted(p for p in work.rglob("*") if p.is_file() and p.name != PLAN)
    return {str(path.relative_to(work)): fingerprint(path) for path in files}


def copy_missing(source: Path, target: Path) -> None:
    """Copies a file, or the files of a folder, where the target is not there yet."""
    if source.is_dir():
        for path in sorted(p for p in source.rglob("*") if p.is_file()):
            copy_missing(path, target / path.relative_to(source))
    elif source.is_file() and not target.is_file():
        with replacing(target) as temporary:
            shutil.copyfile(source, temporary)


def write_npz(path: Path, **arrays: np.ndarray) -> None:
    """Writes compressed arrays, all of them or nothing."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def _versions(packages: Sequence[str]) -> dict[str, str]:
    """Versions of gausim, Python and the packages; ``absent`` for one that is not installed."""
    found = {"gausim": gausim.__version__, "python": platform.python_version()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found


def _different(manifest: Mapping[str, Any], key: Mapping[str, Any]) -> list[str]:
    return [name for name in key if manifest.get(name) != key[name]]


def _known(out: Path, key: Mapping[str, Any], *, overwrite: bool) -> dict[str, Any] | None:
    """The manifest in ``out`` if it is of this key; None where the stage has to be made."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return None
    if not (out / MANIFEST).is_file():
        raise DataError(
            f"{out}: exists and is not the result of a stage ({MANIFEST} is missing). Choose another --out."
        )
    manifest = read_manifest(out)
    different = _different(manifest, key)
    if different and not overwrite:
        raise DataError(
            f"{out / MANIFEST}: a result of other {', '.join(different)} is there. Choose another --out, or replace "
            "it with --overwrite."
        )
    return None if different else manifest


def _open_work(work: Path, key: Mapping[str, Any]) -> None:
    """An empty working directory, or the one of an interrupted attempt at the very same."""
    plan = work / PLAN
    try:
        same = json.loads(plan.read_bytes()) == key
    except (OSError, ValueError):
        same = False
    if same:
        remove_leftovers(work, deep=True)
    else:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        write_json(plan, key)
