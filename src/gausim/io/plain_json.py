"""JSON as its standard has it: no NaN, no infinity, no numbers that no machine number holds, nesting within reason."""

from __future__ import annotations

import json
import math
from typing import Any

# No field of ours needs an integer beyond 64 bits.
_LARGEST = 1 << 63
_MOST_DIGITS = 24


def parse_json(text: str | bytes) -> Any:
    """What a JSON text says.

    Raises:
        ValueError: it is no JSON, or holds NaN, infinity, a number beyond 64 bits (naming the field) or thousands of
            nested brackets.
    """
    bad: list[str] = []

    def number(word: str) -> float:
        value = float(word)
        if not math.isfinite(value):
            bad.append(word)
        return value

    def integer(word: str) -> int | float:
        value = int(word) if len(word) <= _MOST_DIGITS else math.inf
        if not -_LARGEST <= value < _LARGEST:
            bad.append(word)
            return math.inf
        return value

    try:
        data = json.loads(text, parse_constant=number, parse_float=number, parse_int=integer)
        if bad:
            place = _first_bad(data)
            field = f"field '{place}'" if place else "a field that is stated twice"
            raise ValueError(f"{field} is {bad[0]:.40}, expected a number of 64 bits")
    except RecursionError:
        raise ValueError("brackets are nested too deep") from None
    return data


def _first_bad(data: Any, where: str = "") -> str | None:
    """Where the first number that is not finite stands, such as ``frames[3].fl_x``."""
    if isinstance(data, float):
        return None if math.isfinite(data) else where or "."
    if isinstance(data, dict):
        items = [(f"{where}.{key}" if where else str(key), value) for key, value in data.items()]
    elif isinstance(data, list):
        items = [(f"{where}[{i}]", value) for i, value in enumerate(data)]
    else:
        return None
    return next((found for name, value in items if (found := _first_bad(value, name)) is not None), None)
