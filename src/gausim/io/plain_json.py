"""JSON as its standard has it: no NaN, no infinity, no numbers that no machine number holds, nesting within reason."""

from __future__ import annotations

import json
import math
from typing import Any

# A double holds no more than 309 digits, and no field of ours needs an integer beyond 64 bits.
_LARGEST = 1 << 63


def parse_json(text: str | bytes) -> Any:
    """What a JSON text says.

    Raises:
        ValueError: it is no JSON, or holds NaN, infinity, a number beyond 64 bits or thousands of nested brackets.
    """
    try:
        return json.loads(text, parse_constant=_constant, parse_float=_float, parse_int=_integer)
    except RecursionError:
        raise ValueError("brackets are nested too deep") from None


def _constant(word: str) -> Any:
    raise ValueError(f"{word} is no number in JSON")


def _float(word: str) -> float:
    value = float(word)
    if not math.isfinite(value):
        raise ValueError(f"the number {word:.40} is too large")
    return value


def _integer(word: str) -> int:
    value = int(word) if len(word) < 25 else _LARGEST
    if not -_LARGEST <= value < _LARGEST:
        raise ValueError(f"the number {word:.40} is too large")
    return value
