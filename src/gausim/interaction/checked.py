"""Records whose fields are validated against their annotations at construction, from files or from Python."""

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
                what = str(error).replace("`", "").replace("array", "list")
                raise ConfigError(f"field '{name}': {what[:1].lower()}{what[1:]}, got {str(value)[:80]!r}.") from error
            if converted is not value:  # a list converted to a tuple, or an integer to a float
                msgspec.structs.force_setattr(self, name, converted)


def made(kind: type[Any], fields: Any) -> Any:
    """Constructs a record from the fields of a file or a command line.

    Raises:
        ConfigError: ``fields`` is no dictionary, a field is missing or unknown, or a value is invalid.
    """
    try:
        return kind(**fields)
    except TypeError as error:
        raise ConfigError(f"{kind.__name__.lower()}: {str(error)[:200]}.") from error


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)
