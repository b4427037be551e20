"""Completes configurations with the defaults of the constructors they name, so that later defaults change no run."""

from __future__ import annotations

import inspect
import json
import pkgutil
from collections.abc import Iterator, Mapping
from typing import Any

OURS = "gausim."


def with_defaults(config: Any) -> Any:
    """A configuration in which every node that builds an object of gausim states the plain defaults of its arguments.

    Null defaults are left out: a missing argument means the same.

    Args:
        config: plain containers, interpolations resolved.
    """
    if isinstance(config, Mapping):
        found = {key: with_defaults(value) for key, value in config.items()}
        return {**found, **{k: v for k, v in _defaults(found.get("_target_")) if k not in found}}
    return [with_defaults(value) for value in config] if isinstance(config, list | tuple) else config


def _defaults(target: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(target, str) or not target.startswith(OURS):
        return
    try:
        parameters = inspect.signature(pkgutil.resolve_name(target)).parameters
    except (ImportError, AttributeError, TypeError, ValueError):
        return  # building the node reports the error
    for name, parameter in parameters.items():
        if (default := _plain(parameter.default)) not in (None, [], {}):
            yield name, default


def flatten(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested mappings."""
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from flatten(inner, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, value


def _plain(value: Any) -> Any:
    """The value as JSON holds it; None for what JSON does not know."""
    try:
        return json.loads(json.dumps(value))
    except (TypeError, ValueError):
        return None
