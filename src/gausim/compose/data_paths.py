"""Paths of a run's data on this machine, by its configuration and its replacements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gausim.core.errors import ConfigError, DataError
from gausim.runs.names import CONFIG

# Folder in a packed run for rest scenes from outside its data set.
SCENES = "scenes"
_FILES = ("scene", "masks")


def data_option(words: Sequence[str]) -> dict[str, Any]:
    """Parses the words of ``--data`` to keys of the data configuration.

    Raises:
        ConfigError: a key is given twice.
    """
    given: dict[str, Any] = {}
    roots = []
    for word in words:
        key, _, value = word.partition("=")
        if key == "root" and value:
            roots.append(value)
        elif key not in _FILES or not value:
            roots.append(word)
        elif key in given:
            raise ConfigError(f"--data {word}: {key} is given twice.")
        else:
            given[key] = value
    return {**given, **({"root": roots[0] if len(roots) == 1 else roots} if roots else {})}


def located(run_dir: Path, data: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The data configuration of a run with the paths on this machine, after replacing the keys ``given``.

    A missing scene or masks file is searched in ``RUN/scenes``, a folder of packed runs. The checkpoint contains
    fingerprints of its scenes, so that a wrong file is refused later.

    Raises:
        DataError: a path does not exist; the message names the option to set it.
    """
    merged = {**data, **given, "root": _roots(data.get("root"), given.get("root"))}
    if isinstance(merged["root"], list):
        merged["root"] = [
            _placed(run_dir, entry, f"data.root[{i}]") if isinstance(entry, Mapping) else entry
            for i, entry in enumerate(merged["root"])
        ]
    merged = _placed(run_dir, merged, "data")
    for root in listed(merged["root"]):
        path = root.get("root") if isinstance(root, Mapping) else root
        if path is not None and not Path(path).is_dir():
            raise DataError(_missing(run_dir, "data.root", path, "--data DIR", "a directory"))
    return merged


def absolute(data: Mapping[str, Any]) -> dict[str, Any]:
    """A data configuration, or an entry of its list ``root``, with absolute paths."""
    placed = {key: str(Path(data[key]).resolve()) for key in _FILES if data.get(key)}
    entries = [absolute(e) if isinstance(e, Mapping) else e and str(Path(e).resolve()) for e in listed(data["root"])]
    return {**data, **placed, "root": entries if isinstance(data["root"], list) else entries[0]}


def outside_files(run_dir: Path, data: Mapping[str, Any]) -> list[Path]:
    """Scenes and masks outside the data set that a data configuration names, including masks beside their scene.

    Raises:
        DataError: a file does not exist.
    """
    data = located(run_dir, data, {})
    entries = [entry for entry in listed(data["root"]) if isinstance(entry, Mapping)]
    found = []
    for entry in [data, *entries]:
        scene, masks = entry.get("scene"), entry.get("masks")
        beside = Path(scene).with_suffix(".masks.npz") if scene and not masks else None
        found += [Path(path) for path in (scene, masks) if path]
        found += [beside] if beside is not None and beside.is_file() else []
    return found


def listed(root: Any) -> list[Any]:
    """The entries of ``data.root`` as a list, also if it is a single one."""
    return root if isinstance(root, list) else [root]


def _roots(own: Any, given: Any) -> Any:
    """The given directories; if their number matches the configuration, entries keep their other keys."""
    if given is None:
        return own
    entries, replaced = listed(own), listed(given)
    if len(entries) != len(replaced) or not any(isinstance(entry, Mapping) for entry in entries):
        return given
    return [
        {**old, "root": new} if isinstance(old, Mapping) else new for old, new in zip(entries, replaced, strict=True)
    ]


def _placed(run_dir: Path, entry: Mapping[str, Any], field: str) -> dict[str, Any]:
    placed = dict(entry)
    for key in _FILES:
        path = entry.get(key)
        if path is None or Path(path).is_file():
            continue
        packed = run_dir / SCENES / Path(path).name
        if not packed.is_file():
            raise DataError(_missing(run_dir, f"{field}.{key}", path, f"--data {key}=FILE", "a file"))
        placed[key] = str(packed)
    return placed


def _missing(run_dir: Path, field: str, path: Any, option: str, kind: str) -> str:
    key, value = option.removeprefix("--data ").partition("=")[::2]
    setting = f"data.{key}={value}" if value else "data.root=DIR"
    return (
        f"{run_dir / CONFIG}: field {field} names {path}, expected {kind}, found none on this machine. Give it "
        f"with {option} (evaluate, simulate, export, view), as {setting} to a training by this configuration, or write "
        "its path into that field."
    )
