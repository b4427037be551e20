"""The JSON schema of a training configuration, derived from conf/, the root keys and the signatures of targets."""

from __future__ import annotations

import collections.abc
import inspect
import pkgutil
import re
import types
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from omegaconf import MISSING

from gausim.compose.places import Place, choices, read_places
from gausim.compose.root import RootConfig

Schema = dict[str, Any]

# Placeholder for any value: an interpolation, or ??? for a missing value.
INTERPOLATION = r"\$\{|^\?\?\?$"
# Keys that Hydra reads from a node with a target.
_SPECIAL: Schema = {
    "_target_": {"type": "string"},
    "_partial_": {"type": "boolean"},
    "_recursive_": {"type": "boolean"},
    "_convert_": {"enum": ["none", "partial", "object", "all"]},
    "_args_": {"type": "array"},
}
_PLAIN = {bool: "boolean", int: "integer", float: "number", str: "string", type(None): "null", Path: "string"}
# Keys with arbitrary content.
_RECORDS = ("ablation", "experiment")
# Mappings with arbitrary names, whose entries have targets.
_NAMED = ("callbacks", "logger")


def training_schema() -> Schema:
    """The schema of every file that sets training keys: an experiment, or the saved `config.yaml` of a run.

    Every key is optional, as an experiment sets only what it changes. Unknown keys are errors wherever conf/ or a
    signature defines the known ones. The schema follows draft 7.
    """
    builder = _Builder()
    root, notes = read_places(), documented(RootConfig)
    properties: Schema = {"defaults": _defaults(), "hydra": {"type": "object"}}
    names = vars(inspect.getmodule(RootConfig))
    for entry in fields(RootConfig):
        hint = _hint(entry.type, names)
        if is_dataclass(hint):  # it says everything
            found = _closed({field.name: _leaf(_hint(field.type, names)) for field in fields(hint)})
        elif entry.name in _RECORDS:
            found = {"type": ["object", "null"]}
        elif entry.name in root.children and (root.children[entry.name].children or root.children[entry.name].targets):
            found = builder.place(entry.name, root.children[entry.name])
        else:
            found = _leaf(hint)
        properties[entry.name] = _described(found, notes.get(entry.name, ""))
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "Training configuration of gausim",
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
        "definitions": builder.definitions,
    }


def required_keys() -> list[str]:
    """The root keys that a training requires."""
    return [entry.name for entry in fields(RootConfig) if entry.default == MISSING]


def documented(subject: Any) -> dict[str, str]:
    """Descriptions of arguments or attributes in a Google docstring, in one line each."""
    text = inspect.getdoc(subject) or ""
    section = re.search(r"^(?:Args|Attributes):\n((?:[ ]{4}.*\n?|\n)+)", text, re.MULTILINE)
    entries = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", section.group(1) if section else "", re.MULTILINE)
    return {name: " ".join(said.split()) for name, said in entries}


class _Builder:
    """Builder of the schemas of places; each is defined once, by its path."""

    def __init__(self) -> None:
        self.definitions: Schema = {}

    def place(self, path: str, place: Place) -> Schema:
        """A reference to the schema of a place."""
        if path not in self.definitions:
            self.definitions[path] = {}  # reserves the position before its children
            self.definitions[path] = self._built(path, place) if place.targets else self._plain(path, place)
        return _or_interpolation({"$ref": f"#/definitions/{path}"})

    def _plain(self, path: str, place: Place) -> Schema:
        """Schema of a mapping without a target."""
        found = _closed({name: self._child(f"{path}.{name}", child, {}) for name, child in place.children.items()})
        if path in _NAMED:
            found["additionalProperties"] = {"type": ["object", "null"], "required": ["_target_"]}
        return found

    def _built(self, path: str, place: Place) -> Schema:
        """Schema of a node with targets: the target defines the arguments; without one, those of all targets."""
        known = {target: self._arguments(path, place, target) for target in place.targets}
        every: Schema = {}
        for properties, _ in known.values():
            for name, schema in properties.items():
                every[name] = schema if every.get(name, schema) == schema else {"anyOf": [every[name], schema]}
        strict = [
            {
                "if": {"properties": {"_target_": {"const": target}}, "required": ["_target_"]},
                "then": _closed({**_SPECIAL, **properties}, closed=is_closed),
            }
            for target, (properties, is_closed) in known.items()
        ]
        return {
            "type": ["object", "null"],
            "if": {"required": ["_target_"], "type": "object"},
            "then": {"properties": {"_target_": {"type": "string", "examples": place.targets}}, "allOf": strict},
            "else": _closed({**_SPECIAL, **every}, closed=all(is_closed for _, is_closed in known.values())),
        }

    def _arguments(self, path: str, place: Place, target: str) -> tuple[Schema, bool]:
        """Schemas of the arguments that a target takes from a configuration, and whether the list is complete."""
        found = pkgutil.resolve_name(target)
        init = inspect.unwrap(found.__init__ if isinstance(found, type) else found)  # type: ignore[misc]
        notes = {**documented(found), **documented(init)}
        properties, is_closed = {}, True
        for name, parameter in inspect.signature(found).parameters.items():
            child = place.children.get(name)
            if parameter.kind is parameter.VAR_KEYWORD:
                # The code passes the named arguments of a TypedDict; others may be anything.
                is_closed = is_closed and str(parameter.annotation).startswith("Unpack[")
            elif parameter.kind is parameter.VAR_POSITIONAL:
                continue
            elif child is not None or parameter.default is not parameter.empty:  # the code passes the others
                hint = _hint(parameter.annotation, getattr(init, "__globals__", {}))
                schema = self._child(f"{path}.{name}", child or Place(), hint)
                properties[name] = _described(schema, (child.comment if child else "") or notes.get(name, ""))
        return properties, is_closed

    def _child(self, path: str, place: Place, hint: Any) -> Schema:
        if place.targets:
            return self.place(path, place)
        if not place.children:
            return _described(_leaf(hint), place.comment)
        if hint == {}:
            return self.place(path, place)
        whole = place.merged()  # a mapping with arbitrary names
        if whole.targets or whole.children:
            inner = self.place(f"{path}.*", whole)
        else:
            inner = _leaf(_mapped(hint))
        return _or_interpolation({"type": ["object", "null"], "additionalProperties": inner})


def _closed(properties: Schema, *, closed: bool = True) -> Schema:
    found: Schema = {"type": ["object", "null"], "properties": properties}
    return found | ({"additionalProperties": False} if closed else {})


def _described(schema: Schema, text: str) -> Schema:
    return {**({"description": text} if text else {}), **schema}


def _or_interpolation(schema: Schema) -> Schema:
    return {"if": {"type": "string", "pattern": INTERPOLATION}, "then": True, "else": schema}


def _leaf(hint: Any) -> Schema:
    found = _of_hint(hint)
    return _or_interpolation(found) if found else {}


def _hint(annotation: Any, names: dict[str, Any]) -> Any:
    """The type of an annotation; {} (any value) if its names exist for type checkers only."""
    if annotation is inspect.Parameter.empty:
        return {}
    try:
        return eval(annotation, dict(names)) if isinstance(annotation, str) else annotation  # of targets in conf/
    except (NameError, TypeError, AttributeError):
        return {}


def _mapped(hint: Any) -> Any:
    """The type of a mapping's values."""
    for option in get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,):
        origin = get_origin(option)
        if isinstance(origin, type) and issubclass(origin, collections.abc.Mapping):
            return get_args(option)[1]
    return {}


def _of_hint(hint: Any) -> Schema:
    """The schema of a type in YAML; {} if YAML cannot represent it."""
    origin, inner = get_origin(hint), get_args(hint)
    if isinstance(hint, type) and hint in _PLAIN:
        return {"type": _PLAIN[hint]}
    if hint is None:
        return {"type": "null"}
    if origin is Literal:
        return {"enum": list(inner)}
    if origin in (Union, types.UnionType):
        options = [_of_hint(option) for option in inner]
        return _one_of(options) if all(options) else {}
    if isinstance(origin, type) and issubclass(origin, collections.abc.Mapping):
        return {"type": "object", "additionalProperties": _leaf(inner[1])}
    if isinstance(origin, type) and issubclass(origin, collections.abc.Iterable):
        return _sequence(inner, is_tuple=origin is tuple)
    if origin is collections.abc.Callable or (isinstance(hint, type) and hint.__module__.startswith("gausim.")):
        return {"type": "object", "required": ["_target_"]}
    return {}


def _sequence(inner: tuple[Any, ...], *, is_tuple: bool) -> Schema:
    if not is_tuple or inner[-1] is ...:
        return {"type": "array", "items": _leaf(inner[0])}
    return {"type": "array", "items": [_leaf(part) for part in inner], "minItems": len(inner), "maxItems": len(inner)}


def _one_of(options: list[Schema]) -> Schema:
    """Schema of alternatives; those that consist of a type alone are joined, for readability."""
    plain = list(dict.fromkeys(option["type"] for option in options if option.keys() == {"type"}))
    rest = [option for option in options if option.keys() != {"type"}]
    kinds: list[Schema] = [{"type": plain if len(plain) > 1 else plain[0]}] if plain else []
    return kinds[0] if not rest and kinds else {"anyOf": kinds + rest}


def _defaults() -> Schema:
    """Schema of the defaults list: groups and the names of their files."""
    names: Schema = {}
    for group, files in choices().items():
        schema = {"anyOf": [{"enum": [*files, None]}, {"type": "array", "items": {"enum": files}}]}
        names |= {f"override /{group}": schema, f"/{group}": schema}
    entry = {"anyOf": [{"type": "string"}, {"type": "object", "properties": names}]}
    return {"type": "array", "items": entry, "description": "Files that are composed first, in this order."}
