"""Diagnosis of the oscillation of predictions and truth, read from metrics.json (``diagnosis``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from gausim.report.gather.runs import dig
from gausim.results.curves import TRUTH

Number = float | None


class Motion(msgspec.Struct):
    """Motion of one row, with None for undefined figures."""

    spectrum: list[float]  # power per frequency
    frequencies: list[Number]  # frequency of each principal motion [Hz]
    dampings: list[Number]  # damping of each principal motion, as a fraction of critical damping
    phase_error: list[Number] = []  # phase error per frame [degrees]
    velocity_cosine: Number = None  # cosine between the first velocity and the true one
    level_errors: list[Number] = []  # errors over the static prediction's of the units of each level, the finest first


class Diagnosis(msgspec.Struct):
    """Diagnosis of one object."""

    # fraction of the squared displacement in each principal motion (key ``share`` of the file)
    fraction: list[float] = msgspec.field(name="share")
    frequency: list[float]  # frequencies of the spectra [Hz]
    rows: dict[str, Motion]  # the truth and the predictions
    first_unseen: int = 0  # first unseen frame

    def frequency_error(self, row: str) -> float:
        """Mean over principal motions, weighted by :attr:`fraction`, of the relative error of the frequency."""
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
        known, weights = np.isfinite(values), numbers(self.fraction)
        return float(np.average(values[known], weights=weights[known])) if weights[known].any() else float("nan")


def read_diagnosis(entry: Mapping[str, Any]) -> Diagnosis | None:
    """The diagnosis of an object's entry in metrics.json; None if it is missing or malformed."""
    try:
        found = msgspec.convert(entry.get("diagnosis"), Diagnosis)
        found.first_unseen = msgspec.convert(dig(entry, "splits", "seen"), tuple[int, int])[1]
    except msgspec.ValidationError:
        return None
    size = len(found.frequency), len(found.fraction), len(found.fraction)
    sizes = {(len(m.spectrum), len(m.frequencies), len(m.dampings)) for m in found.rows.values()}
    return found if TRUTH in found.rows and sizes == {size} and all(size) else None


def numbers(values: Sequence[Number]) -> np.ndarray:
    """The figures as an array, with NaN for undefined ones."""
    return np.array(values, float)
