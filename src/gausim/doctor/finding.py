"""What an examination finds, and how checks are listed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from gausim.doctor.evidence import Evidence

Severity = Literal["fault", "warning", "note"]
Sureness = Literal["certain", "likely", "possible"]
SEVERITIES: tuple[Severity, ...] = ("fault", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One thing that was found."""

    severity: Severity  # "fault" where it would ruin a training, "warning" where it costs quality, "note" otherwise
    sureness: Sureness  # how sure it is
    what: str  # what is wrong, in a sentence that names cameras, sequences and files
    remedy: str  # what to do
    measured: Mapping[str, Any] = field(default_factory=dict)  # the numbers behind it, for programs
    check: str = ""  # the check that found it, which :func:`gausim.doctor.examine.examine` fills in


@dataclass(frozen=True)
class Check:
    """One examination."""

    name: str  # what it examines
    # look for one kind of fault each; all have this signature
    finders: tuple[Callable[[Evidence], Iterator[Finding]], ...]
    needs: tuple[str, ...] = ()  # checks whose faults would make this one see ghosts; it is left out after such a fault


def listed(names: list[str]) -> str:
    """Names in a sentence: "a", "a and b", "a, b and c"; of more than six only the first five and a count."""
    if len(names) > 6:
        return f"{', '.join(names[:5])} and {len(names) - 5} more"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
