"""How predictions oscillate beside the truth, as metrics.json tells it (``diagnosis``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gausim.report.gather.study import number
from gausim.results.curves import TRUTH


@dataclass(frozen=True, eq=False)
class Motion:
    """How one row moves.

    Attributes:
        spectrum: power per frequency.
        frequencies: of each principal motion [Hz]; NaN where unknown.
        dampings: fraction of critical; NaN where it does not oscillate.
        phase_error: per frame [degrees]; empty for the truth.
        cosine: of the first velocity to the true one; NaN for the truth.
        levels: error over the static prediction's of the units of each level, the small ones first; empty where there
            is no hierarchy.
    """

    spectrum: np.ndarray
    frequencies: np.ndarray
    dampings: np.ndarray
    phase_error: np.ndarray
    cosine: float
    levels: np.ndarray

    @property
    def small(self) -> float:
        """Error of the smallest units; NaN without a hierarchy."""
        return float(self.levels[0]) if len(self.levels) else float("nan")

    @property
    def large(self) -> float:
        """Error of the largest units; NaN without a hierarchy."""
        return float(self.levels[-1]) if len(self.levels) else float("nan")


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is known of the motions of one object.

    Attributes:
        fraction: of the squared displacement in each principal motion.
        frequency: of the spectra [Hz].
        first_unseen: first frame that training did not see.
        rows: the truth and the predictions.
    """

    fraction: np.ndarray
    frequency: np.ndarray
    first_unseen: int
    rows: Mapping[str, Motion]

    def frequency_error(self, row: str) -> float:
        """Mean over principal motions, weighted by :attr:`fraction`, of the relative error of the frequency."""
        found, true = self.rows[row].frequencies, self.rows[TRUTH].frequencies
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._mean(np.where(true > 0, np.abs(found / true - 1), np.nan))

    def damping_ratio(self, row: str) -> float:
        """Predicted over true damping, both as weighted means over the principal motions that oscillate in both."""
        found, true = self.rows[row].dampings, self.rows[TRUTH].dampings
        both = np.isfinite(found) & np.isfinite(true)
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(self._mean(np.where(both, found, np.nan)) / self._mean(np.where(both, true, np.nan)))

    def phase(self, row: str, *, seen: bool) -> float:
        """Mean phase error of the seen or the unseen frames [degrees]."""
        values = self.rows[row].phase_error
        return _nanmean(values[: self.first_unseen] if seen else values[self.first_unseen :])

    def _mean(self, values: np.ndarray) -> float:
        known = np.isfinite(values)
        total = float(self.fraction[known].sum())
        return float((self.fraction[known] * values[known]).sum() / total) if total > 0 else float("nan")


def read_diagnosis(entry: Mapping[str, Any]) -> Diagnosis | None:
    """The diagnosis of an object's entry in metrics.json; None where there is none that makes sense."""
    found, splits = entry.get("diagnosis"), entry.get("splits")
    if not isinstance(found, dict) or not isinstance(found.get("rows"), dict) or not isinstance(splits, dict):
        return None
    fraction, frequency, seen = _numbers(found.get("share")), _numbers(found.get("frequency")), splits.get("seen")
    rows = {str(k): _motion(v, len(fraction), len(frequency)) for k, v in found["rows"].items() if isinstance(v, dict)}
    known = {name: motion for name, motion in rows.items() if motion is not None}
    if TRUTH not in known or not isinstance(seen, list) or len(seen) != 2 or not isinstance(seen[1], int):
        return None
    return Diagnosis(fraction, frequency, seen[1], known)


def _motion(row: Mapping[str, Any], motions: int, bins: int) -> Motion | None:
    power, frequencies, dampings = (_numbers(row.get(key)) for key in ("spectrum", "frequencies", "dampings"))
    if not bins or not motions or (len(power), len(frequencies), len(dampings)) != (bins, motions, motions):
        return None
    (cosine,) = _numbers([row.get("velocity_cosine")])
    phase = _numbers(row.get("phase_error"))
    levels = _numbers(row.get("level_errors"))
    return Motion(power, frequencies, dampings, phase, float(cosine), levels)


def _numbers(values: Any) -> np.ndarray:
    found = [number(v) for v in values] if isinstance(values, list) else []
    return np.array([np.nan if v is None else v for v in found], float)


def _nanmean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")
