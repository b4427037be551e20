"""Records whose fields are validated against their annotations at construction, from files or from Python."""

from __future__ import annotations

from functools import cache
from types import UnionType
from typing import Annotated, Any, get_type_hints

import msgspec
from msgspec import Meta, Struct

from gausim.core.errors import ConfigError

Vector = tuple[float, float, float]
Natural = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]


class Checked(Struct, frozen=True):
    """A validated record of types that msgspec supports (numbers, strings, tuples of them) and of other such records.

    Raises:
        ConfigError: a value has another type or is out of range; the message names the field, the expected and the
            given value.
    """

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():
            value = getattr(self, name)
            try:
                known = isinstance(hint, type | UnionType) and isinstance(value, hint) and isinstance(value, Struct)
                converted = value if known else msgspec.convert(value, hint)
            except (msgspec.ValidationError, TypeError) as error:
                raise ConfigError(f"field '{name}': {_lowered(error)}, got {str(value)[:80]!r}.") from error
            if converted is not value:  # a list converted to a tuple, or an integer to a float
                msgspec.structs.force_setattr(self, name, converted)


def made(kind: type[Any], fields: Any) -> Any:
    """Constructs a record from the fields of a file or a command line.

    Raises:
        ConfigError: ``fields`` is no dictionary, a field is missing or unknown, or a value is invalid.
    """
    if not isinstance(fields, dict):
        raise ConfigError("expected an object.")
    names = {field.name: field.required for field in msgspec.structs.fields(kind)}
    missing = [name for name, required in names.items() if required and name not in fields]
    unknown = [name for name in fields if name not in names]
    if missing or unknown:
        raise ConfigError(f"expected the fields {', '.join(names)}; missing: {missing}, unknown: {str(unknown)[:200]}.")
    return kind(**fields)


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _lowered(error: Exception) -> str:
    text = str(error).replace("`", "").replace("array", "list")
    return text[:1].lower() + text[1:]
