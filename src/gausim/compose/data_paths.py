"""Paths of a run's data on this machine, by its configuration and its replacements."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gausim.core.errors import ConfigError, DataError
from gausim.runs.names import CONFIG

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

    The checkpoint contains fingerprints of its scenes, so that a wrong file is refused later.

    Raises:
        DataError: a path does not exist; the message names the option to set it.
    """
    merged = {**data, **given, "root": _roots(data.get("root"), given.get("root"))}
    for entry, field in [(merged, "data"), *((e, f"data.root[{i}]") for i, e in enumerate(listed(merged["root"])))]:
        for key in _FILES if isinstance(entry, Mapping) else ():
            if entry.get(key) is not None and not Path(entry[key]).is_file():
                raise DataError(_missing(run_dir, f"{field}.{key}", entry[key], f"--data {key}=FILE", "a file"))
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


def _missing(run_dir: Path, field: str, path: Any, option: str, kind: str) -> str:
    key, value = option.removeprefix("--data ").partition("=")[::2]
    setting = f"data.{key}={value}" if value else "data.root=DIR"
    return (
        f"{run_dir / CONFIG}: field {field} names {path}, expected {kind}, found none on this machine. Give it "
        f"with {option} (evaluate, simulate, export, view), as {setting} to a training by this configuration, or write "
        "its path into that field."
    )
