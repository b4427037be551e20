"""Atomic writing of files, and their hashes."""

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from gausim.core.errors import DataError

# Bounds of YAML files: bytes, and values when aliases are written out. A configuration has a hundredth of it.
_MOST_YAML, _MOST_VALUES, _LONGEST = 1 << 22, 100_000, 200
_LEFTOVER = re.compile(r"\..+\.\d+\.tmp(\.\w+)?")


@contextmanager
def replacing(path: Path, *, previous: Path | None = None, typed: bool = False) -> Iterator[Path]:
    """A temporary file that takes the name ``path`` when the block ends without an error.

    After a crash the file has either the old or the new content: the temporary file is in the same directory (made
    if missing) and is flushed to the disk before it is renamed; then the directory entry is flushed, too. An
    existing file is renamed to ``previous``, if given. ``typed`` gives the temporary file the same suffix, for
    writers that depend on it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp{path.suffix if typed else ''}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        if previous is not None and path.is_file():
            os.replace(path, previous)  # for a moment only ``previous`` exists
        os.replace(temporary, path)
        _sync_directory(path.parent)
    except OSError as error:
        if error.filename is None:  # a full disk does not say of which file
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_durably(
    path: Path, data: bytes, *, check: Callable[[Path], object] | None = None, previous: Path | None = None
) -> None:
    """Writes a file atomically, see :func:`replacing`.

    ``check`` is called with the temporary file and raises if its content is wrong.
    """
    with replacing(path, previous=previous) as temporary:
        temporary.write_bytes(data)
        if check is not None:
            check(temporary)


def write_json(path: Path, data: Any) -> None:
    """Writes plain data as indented JSON, atomically.

    Raises:
        ValueError: a number is NaN or infinite, which JSON cannot represent.
    """
    write_durably(path, json.dumps(data, indent=1, allow_nan=False).encode() + b"\n")


def read_yaml(path: Path) -> dict[str, Any]:
    """A mapping from a YAML file, with the safe loader: no tag builds an object.

    Raises:
        ValueError: the file is missing, not YAML, has too many values or is not a mapping.
    """
    loaded = bounded_yaml(path)
    if not isinstance(loaded, dict):
        raise ValueError(f"{path}: expected a mapping, got {type(loaded).__name__}.")
    return loaded


def bounded_yaml(path: Path) -> Any:
    """What a YAML file contains, as :func:`read_yaml` reads it."""
    try:
        if path.stat().st_size > _MOST_YAML:
            raise yaml.YAMLError(f"has {path.stat().st_size} bytes, more than {_MOST_YAML}")
        loaded = yaml.safe_load(path.read_text())
        _expanded(loaded, {})
        return loaded
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"{path}: cannot be read as YAML ({' '.join(str(error).split())}).") from error


def _expanded(value: Any, known: dict[int, int]) -> int:
    """Number of values when aliases are written out.

    Raises:
        yaml.YAMLError: there are too many, or an alias contains itself.
    """
    if not isinstance(value, dict | list):
        return 1
    if id(value) not in known:
        known[id(value)] = _MOST_VALUES + 1  # until it is known, which only a cycle meets
        children = value.values() if isinstance(value, dict) else value
        known[id(value)] = 1 + sum(_expanded(child, known) for child in children)
    if known[id(value)] > _MOST_VALUES:
        raise yaml.YAMLError(f"has more than {_MOST_VALUES} values when its aliases are written out")
    return known[id(value)]


def safe_name(name: str, where: str) -> str:
    """A name that becomes part of a path below a folder, unchanged.

    Raises:
        DataError: a path made of it would leave the folder, or no file system has it.
    """
    parts = name.replace("\\", "/").split("/")
    if name and (not name.isprintable() or "" in parts or ".." in parts or ":" in parts[0] or len(name) > _LONGEST):
        raise DataError(f"{where}: {name!r:.80} is a path, not a name. Use letters, digits, '-' and '_'.")
    return name


def slashed(folder: Path, name: str) -> str:
    """A file's name in a folder: as it is where that file exists, else with slashes for the backslashes of Windows."""
    return name if "\\" not in name or (folder / name).exists() else name.replace("\\", "/")


def sha256(path: Path) -> str:
    """SHA-256 of a file's content in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove_leftovers(folder: Path, *, deep: bool = False) -> None:
    """Removes the temporary files of processes that were killed while writing, with ``deep`` in subfolders, too.

    No other process may write to the folder at the same time.
    """
    for path in folder.rglob(".*.tmp*") if deep else folder.glob(".*.tmp*"):
        if _LEFTOVER.fullmatch(path.name):
            path.unlink(missing_ok=True)


def _sync_directory(folder: Path) -> None:
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def natural(name: str) -> list[tuple[int, int, str]]:
    """Sorting key by which frame_2 comes before frame_10."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(0, int(part), "") if part[0] in "0123456789" else (1, 0, part) for part in parts]
