"""JSON as its standard has it: no NaN, no infinity, no numbers that no machine number holds, nesting within reason."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from gausim.core.errors import DataError

T = TypeVar("T")


def parse_json(text: str | bytes) -> Any:
    """What a JSON text says.

    Raises:
        ValueError: it is no JSON, or holds NaN, infinity, a number beyond 64 bits or thousands of nested brackets.
    """
    try:
        data = msgspec.json.decode(text)
        msgspec.msgpack.encode(data)  # msgspec reads integers of any length, MessagePack writes those of 64 bits
    except RecursionError:
        raise ValueError("brackets are nested too deep") from None
    except OverflowError:
        raise ValueError("an integer has more than 64 bits") from None
    return data


def checked(value: Any, kind: type[T], where: str, remedy: str) -> T:
    """Plain data as a record or another annotated ``kind``; messages begin with ``where`` and end with ``remedy``.

    Raises:
        DataError: a value is missing, of another type or out of its range; names the field.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        text, _, place = str(error).replace("`", "'").partition(" - at '$.")
        field = f"field '{place}: " if place else ""
        raise DataError(f"{where}: {field}{text[0].lower()}{text[1:]}. {remedy}") from error
