"""The part of a data set that is reserved for the final test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from msgspec import Struct

from gausim.core import DataError
from gausim.io.plain_json import checked


class ReservedPart(Struct, frozen=True, forbid_unknown_fields=True):
    """Sequences that training sees only the seen frames of, as images; nothing is tuned on the others."""

    sequences: tuple[str, ...] | Literal["all"] = "all"  # their names, or ``all``
    # only objects made from one of these seeds (field ``seed`` of ``dataset.json``) have a test part; null: every
    # object
    seeds: tuple[int, ...] | None = None

    def of(self, found: Sequence[str], seed: object, where: str) -> set[str]:
        """The reserved ones of the sequences ``found`` of an object that was made from ``seed``.

        Raises:
            DataError: a reserved sequence does not exist.
        """
        if self.seeds is not None and seed not in self.seeds:
            return set()
        if self.sequences == "all":
            return set(found)
        absent = sorted(set(self.sequences) - set(found))
        if absent:
            raise DataError(
                f"{where}: field 'test.sequences' reserves {absent}, the object has {list(found)}. Correct the names."
            )
        return set(self.sequences)


def reserved_part(value: Mapping[str, Any] | None, where: str) -> ReservedPart | None:
    """Reads a declaration; None if there is none.

    Raises:
        DataError: a field is unknown or wrong.
    """
    if value is None:
        return None
    remedy = "Expected {sequences: [NAME, ...] or all, seeds: [NUMBER, ...] or absent}."
    return checked(dict(value) if isinstance(value, Mapping) else value, ReservedPart, where, remedy)
