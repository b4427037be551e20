"""Checks training configurations without training; reports every wrong key with the nearest valid one."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from jsonschema import Draft7Validator, ValidationError
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gausim.compose.config import compose_leniently, instantiate
from gausim.compose.places import GLOBAL_PACKAGE, ROOT_FILE, choices, option_of
from gausim.compose.root import conf_dir
from gausim.compose.schema import required_keys, training_schema
from gausim.compose.targets import target_faults
from gausim.core.errors import ConfigError, GausSimError
from gausim.io.files import read_yaml

RUN_CONFIG = "config.yaml"
# Nodes that are built for the checks of their constructors; none of them reads data or writes files.
_BUILT = ("data", "supervision", "loss", "optimizer", "render")


def faults(arguments: Sequence[str]) -> list[str]:
    """Errors of a configuration, key by key, a sentence each; data sets are not checked.

    The arguments are one saved configuration (a YAML file, or a run directory); or those of `gausim train`:
    overrides, names of experiments, and files of conf/ or of a folder like it (`MINE/experiment/NAME.yaml`).

    Raises:
        ConfigError: an argument is not a configuration, or a saved one is combined with other arguments.
    """
    saved = [path for path in map(_saved, arguments) if path is not None]
    if saved and len(arguments) > 1:
        raise ConfigError(f"{saved[0]}: expected a saved configuration alone, got {len(arguments)} arguments.")
    if saved:
        whole = _read(saved[0])
        missing = [f"{key}: missing. Every configuration that is trained has it." for key in required_keys()]
        return [fault for fault in missing if fault.split(":")[0] not in whole] + check(whole)
    overrides = _search_path(arguments) + [said for argument in arguments if (said := _override(argument))]
    config, found = compose_leniently(ROOT_FILE, overrides)
    try:
        return found + check(OmegaConf.to_container(config, resolve=True))
    except OmegaConfBaseException as error:
        return [*found, f"{getattr(error, 'full_key', None) or 'configuration'}: {str(error).splitlines()[0]}"]


def check(config: Any) -> list[str]:
    """The errors of a whole configuration in plain containers with resolved interpolations."""
    found = list(target_faults(config))
    if found:
        return found  # arguments of invalid targets are unknown
    schema = training_schema()
    errors = Draft7Validator(schema).iter_errors(config)
    found = sorted({message for error in errors for message in _messages(error, schema)})
    return found or list(_contradictions(config))


def _saved(argument: str) -> Path | None:
    """The file of a saved configuration, if the argument names one: a run directory, or a file outside of groups."""
    path = Path(argument)
    path = path / RUN_CONFIG if (path / RUN_CONFIG).is_file() else path
    is_file = path.suffix in (".yaml", ".yml") and path.is_file()
    return path if is_file and _group(path) is None else None


def _group(path: Path) -> str | None:
    """The group of a file, by its folder in conf/ or its folder's name elsewhere; "" for conf/ itself."""
    folder = path.resolve().parent
    if folder.is_relative_to(conf_dir()):
        return option_of(path.resolve())[0]
    return folder.name if folder.name in choices() else None


def _search_path(arguments: Sequence[str]) -> list[str]:
    """Override of Hydra's search path for files outside of conf/, like `--config-dir` of `gausim train`."""
    files = [Path(argument).resolve() for argument in arguments if Path(argument).is_file()]
    roots = sorted({f"'file://{file.parent.parent}'" for file in files if not file.is_relative_to(conf_dir())})
    return [f"hydra.searchpath=[{','.join(roots)}]"] if roots else []


def _override(argument: str) -> str:
    """The argument as an override of `gausim train`; empty for conf/train.yaml itself."""
    path, experiments = Path(argument), choices()["experiment"]
    if path.is_file() and (group := _group(path)) is not None:
        own = path.resolve().is_relative_to(conf_dir())
        return f"{group}={option_of(path.resolve())[1] if own else path.stem}" if group else ""
    if "=" in argument or argument.startswith("~"):
        return argument
    if argument in experiments:
        return f"experiment={argument}"
    if "/" in argument or path.suffix:
        raise ConfigError(f"{argument}: expected a YAML file or a run directory with {RUN_CONFIG}, found neither.")
    raise ConfigError(
        f"'{argument}': expected KEY=VALUE, a file, a run or an experiment.{_nearest(argument, experiments)}"
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        loaded = read_yaml(path)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if "defaults" in loaded or GLOBAL_PACKAGE in path.read_text().splitlines():
        raise ConfigError(f"{path}: is composed with others. Put it into a folder named experiment (or ablation, ...).")
    return loaded


def _contradictions(config: dict[str, Any]) -> Iterator[str]:
    """Errors that the constructors raise."""
    for key in _BUILT:
        if isinstance(config.get(key), dict) and "_target_" in config[key]:
            try:
                instantiate(OmegaConf.create(config)[key])
            except (GausSimError, ValueError) as error:
                yield f"{key}: {error}"


def _messages(error: ValidationError, whole: Mapping[str, Any]) -> Iterator[str]:
    """Messages for one violation of the schema."""
    path = ".".join(map(str, error.absolute_path))
    schema, instance = error.schema, error.instance
    assert isinstance(schema, dict)
    if error.validator == "additionalProperties":
        known = list(schema.get("properties", {}))
        target = instance.get("_target_")
        for key in sorted(set(map(str, instance)) - set(known)):
            where = f"{path}.{key}" if path else key
            yield f"{where}: unknown key{f' of {target}' if target else ''}.{_nearest(key, known)}"
    elif error.validator == "required":
        *parent, key = map(str, error.absolute_path)
        siblings = whole["definitions"].get(".".join(parent), {}).get("properties", {})
        near = _nearest(key, [name for name in siblings if name != key])
        yield f"{path}: expected a node with `_target_`, the class or function to build.{near}"
    else:
        yield f"{path or 'configuration'}: expected {_expected(schema)}, got {_short(instance)}."


def _expected(schema: Any) -> str:
    """Text of a schema for messages."""
    schema = schema.get("else", schema)  # skip the alternative of an interpolation
    if "enum" in schema:
        return f"one of {', '.join(map(str, schema['enum']))}"
    if "anyOf" in schema:
        return " or ".join(_expected(option) for option in schema["anyOf"])
    kinds = [schema["type"]] if isinstance(schema.get("type"), str) else list(schema.get("type", ["another value"]))
    words = " or ".join(_WORDS.get(kind, kind) for kind in kinds)
    count = schema.get("minItems")
    return f"{words} of {count}" if count else words


_WORDS = {
    "object": "a mapping",
    "array": "a list",
    "string": "a text",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
}


def _short(value: Any) -> str:
    text = "null" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _nearest(key: str, known: Sequence[str]) -> str:
    matches = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    return f" Did you mean '{matches[0]}'?" if matches else f" Known: {', '.join(sorted(known))}." if known else ""
