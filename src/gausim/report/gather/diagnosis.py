"""How predictions oscillate beside the truth, as metrics.json tells it (``diagnosis``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from gausim.report.gather.runs import dig
from gausim.results.curves import TRUTH

Number = float | None


class Motion(msgspec.Struct):
    """How one row moves; None where a figure is not defined, and no phase, cosine or levels where there are none.

    Attributes:
        spectrum: power per frequency.
        frequencies: of each principal motion [Hz].
        dampings: fraction of critical.
        phase_error: per frame [degrees].
        velocity_cosine: of the first velocity to the true one.
        level_errors: over the static prediction's, of the units of each level of a hierarchy, the small ones first.
    """

    spectrum: list[float]
    frequencies: list[Number]
    dampings: list[Number]
    phase_error: list[Number] = []
    velocity_cosine: Number = None
    level_errors: list[Number] = []


class Diagnosis(msgspec.Struct):
    """What is known of the motions of one object.

    Attributes:
        share: of the squared displacement in each principal motion.
        frequency: of the spectra [Hz].
        rows: the truth and the predictions.
        first_unseen: first frame that training did not see.
    """

    share: list[float]
    frequency: list[float]
    rows: dict[str, Motion]
    first_unseen: int = 0

    def frequency_error(self, row: str) -> float:
        """Mean over principal motions, weighted by :attr:`share`, of the relative error of the frequency."""
        found, true = (numbers(self.rows[r].frequencies) for r in (row, TRUTH))
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._mean(np.where(true > 0, np.abs(found / true - 1), np.nan))

    def damping_ratio(self, row: str) -> float:
        """Predicted over true damping, both as weighted means over the principal motions that oscillate in both."""
        both = np.stack([numbers(self.rows[r].dampings) for r in (row, TRUTH)])
        found, true = np.where(np.isfinite(both).all(0), both, np.nan)
        return self._mean(found) / (self._mean(true) or float("nan"))

    def phase(self, row: str, *, seen: bool) -> float:
        """Mean phase error of the seen or the unseen frames [degrees]."""
        values = numbers(self.rows[row].phase_error)
        part = values[: self.first_unseen] if seen else values[self.first_unseen :]
        return float(part[np.isfinite(part)].mean()) if np.isfinite(part).any() else float("nan")

    def _mean(self, values: np.ndarray) -> float:
        known, share = np.isfinite(values), numbers(self.share)
        return float(np.average(values[known], weights=share[known])) if share[known].any() else float("nan")


def read_diagnosis(entry: Mapping[str, Any]) -> Diagnosis | None:
    """The diagnosis of an object's entry in metrics.json; None where there is none that makes sense."""
    try:
        found = msgspec.convert(entry.get("diagnosis"), Diagnosis)
        found.first_unseen = msgspec.convert(dig(entry, "splits", "seen"), tuple[int, int])[1]
    except msgspec.ValidationError:
        return None
    size = len(found.frequency), len(found.share), len(found.share)
    sizes = {(len(m.spectrum), len(m.frequencies), len(m.dampings)) for m in found.rows.values()}
    return found if TRUTH in found.rows and sizes == {size} and all(size) else None


def numbers(values: Sequence[Number]) -> np.ndarray:
    """The figures as an array, NaN where one is not defined."""
    return np.array(values, float)
