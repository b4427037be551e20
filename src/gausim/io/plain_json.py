"""Strict JSON: no NaN, no infinity, no numbers beyond 64 bits, limited nesting."""

import codecs
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from gausim.core.errors import DataError

T = TypeVar("T")


def parse_json(text: str | bytes) -> Any:
    """Parses a JSON text, with or without a byte order mark of UTF-8.

    Raises:
        ValueError: the text is not JSON, or has NaN, infinity, a number beyond 64 bits or thousands of nested brackets.
    """
    text = text.removeprefix("\ufeff") if isinstance(text, str) else text.removeprefix(codecs.BOM_UTF8)
    try:
        data = msgspec.json.decode(text)
        msgspec.msgpack.encode(data)  # msgspec reads integers of any length; MessagePack refuses those beyond 64 bits
    except RecursionError:
        raise ValueError("brackets are nested too deep") from None
    except OverflowError:
        raise ValueError("an integer has more than 64 bits") from None
    return data


def read_any_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        DataError: it is missing or not JSON.
    """
    try:
        return parse_json(path.read_bytes())
    except FileNotFoundError:
        raise DataError(f"{path}: no such file. Is this the right folder?") from None
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({error}). Restore it.") from error


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file, or a :class:`DataError` that names the file."""
    data = read_any_json(path)
    if not isinstance(data, dict):
        raise DataError(f"{path}: expected a JSON object, got a {type(data).__name__}.")
    return data


def checked(value: Any, kind: Callable[..., T], where: str, remedy: str) -> T:
    """Converts plain data to a record or another annotated ``kind``; messages start with ``where``, end in ``remedy``.

    Raises:
        DataError: a value is missing, of another type or out of range; names the field.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        text, _, place = str(error).replace("`", "'").partition(" - at '$.")
        field = f"field '{place}: " if place else ""
        raise DataError(f"{where}: {field}{text[0].lower()}{text[1:]}. {remedy}") from error
