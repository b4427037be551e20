"""Comparison of the configurations of two runs, key by key."""

from collections.abc import Iterator, Mapping
from typing import Any

# Keys that may differ when a run is resumed: paths, display and hardware, not the training.
FREE_KEYS = (
    "output_root", "logger", "ablation", "trials", "doctor", "evaluate", "overwrite", "retry_failed",
    "trainer", "render.threads",
)  # fmt: skip


def changed_keys(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Dotted keys whose values differ between two configurations, without those that a resumed run may change."""
    return [key for key in differing_keys(old, new) if not is_free(key)]


def is_free(key: str) -> bool:
    """Whether a dotted key may change when a run is resumed."""
    return any(key == free or key.startswith(f"{free}.") for free in FREE_KEYS)


def differing_keys(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Dotted keys whose values differ between two configurations."""
    first, second = dict(flatten(old)), dict(flatten(new))
    return [key for key in sorted({*first, *second}) if first.get(key) != second.get(key)]


def flatten(value: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested mappings."""
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from flatten(inner, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, value
