"""Findings and checks of an examination."""

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
    """One finding."""

    severity: Severity  # "fault" if it makes training useless, "warning" if it lowers the quality, else "note"
    sureness: Sureness  # certainty of the finding
    what: str  # the problem, in a sentence that names cameras, sequences and files
    remedy: str  # what to do
    measured: Mapping[str, Any] = field(default_factory=dict)  # measured values, for programs
    check: str = ""  # the check that found it, which :func:`gausim.doctor.examine.examine` fills in


@dataclass(frozen=True)
class Check:
    """One check, made of finders."""

    name: str  # subject of the check
    # one per kind of fault
    finders: tuple[Callable[[Evidence], Iterator[Finding]], ...]
    needs: tuple[str, ...] = ()  # checks whose faults invalidate this one, which is then omitted


def listed(names: list[str]) -> str:
    """Names in a sentence: "a", "a and b", "a, b and c"; of more than six only the first five and a count."""
    if len(names) > 6:
        return f"{', '.join(names[:5])} and {len(names) - 5} more"
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
