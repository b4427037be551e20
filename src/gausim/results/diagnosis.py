"""Diagnosis of predictions whose true motion is known (frequency, damping, phase, first velocity), and its reader."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gausim.metrics.motion import level_error
from gausim.metrics.oscillation import (
    coordinates,
    oscillation,
    phase_error,
    principal_motions,
    spectrum,
    velocity_cosine,
)
from gausim.results.curves import TRUTH, finite

Number = float | None

# Number of principal motions; further ones are too small for an estimate of their frequency.
MOTIONS = 8
# Points used per sequence: enough for smooth motion, few enough for the memory of all sequences.
POINTS = 2048


class Diagnosis:
    """Comparison of true and predicted displacements over all sequences of an object."""

    def __init__(self, fps: float) -> None:
        """Starts without sequences; ``fps`` in frames per second."""
        self._fps = fps
        self._truth: list[NDArray] = []
        self._predicted: dict[str, list[NDArray]] = {}
        self._levels: dict[str, NDArray] = {}

    def add(
        self,
        truth: Tensor,
        rest: Tensor,
        predictions: Mapping[str, Tensor],
        units: Mapping[str, Sequence[Tensor]] | None = None,
    ) -> None:
        """Adds one sequence: true and predicted positions (F, P, 3), the latter by row, and rest positions (P, 3).

        ``units``: for rows with a hierarchy, the unit of each point, level by level, the finest first.
        """
        for name, levels in (units or {}).items():
            pairs = [level_error(predictions[name].to(truth), truth, rest, unit) for unit in levels]
            sums = np.array([[float(error.sum()), float(still.sum())] for error, still in pairs])
            self._levels[name] = self._levels.get(name, 0.0) + sums
        every = -(-truth.shape[1] // POINTS)
        self._truth.append(_thin(truth - rest, every))
        for name, points in predictions.items():
            self._predicted.setdefault(name, []).append(_thin(points - rest.to(points), every))

    def summary(self) -> dict[str, Any] | None:
        """The diagnosis as plain data (see :class:`DiagnosisFigures`), or None if no sequence moves."""
        if not self._truth or not any(np.abs(d).max() > 0 for d in self._truth):
            return None
        shapes, fraction = principal_motions(self._truth, MOTIONS)
        truth = [coordinates(d, shapes) for d in self._truth]
        found: dict[str, Any] = {"share": fraction.tolist(), "frequency": [], "rows": {}}
        for name, motions in {TRUTH: self._truth, **self._predicted}.items():
            series = [coordinates(d, shapes) for d in motions]
            frequency, power = spectrum(series, self._fps)
            rings = [oscillation([s[:, m] for s in series], self._fps) for m in range(len(fraction))]
            row: dict[str, Any] = {
                "spectrum": power.tolist(),
                "frequencies": [finite(ring.frequency) for ring in rings],
                "dampings": [finite(ring.damping) for ring in rings],
            }
            if name != TRUTH:
                row["phase_error"] = [finite(v) for v in phase_error(series, truth)]
                row["velocity_cosine"] = _mean(
                    [velocity_cosine(p, t) for p, t in zip(motions, self._truth, strict=True)]
                )
            if name in self._levels:
                row["level_errors"] = [finite(own / still if still else math.nan) for own, still in self._levels[name]]
            found["frequency"] = frequency.tolist()
            found["rows"][name] = row
        return found


def _thin(displacement: Tensor, every: int) -> NDArray:
    return displacement[:, ::every].detach().cpu().float().numpy()


def _mean(values: Sequence[float]) -> float | None:
    known = [v for v in values if math.isfinite(v)]
    return sum(known) / len(known) if known else None


class Motion(msgspec.Struct):
    """Motion of one row, with None for undefined figures."""

    spectrum: list[float]  # power per frequency
    frequencies: list[Number]  # frequency of each principal motion [Hz]
    dampings: list[Number]  # damping of each principal motion, as a fraction of critical damping
    phase_error: list[Number] = []  # phase error per frame [degrees]
    velocity_cosine: Number = None  # cosine between the first velocity and the true one
    level_errors: list[Number] = []  # errors over the static prediction's of the units of each level, the finest first


class DiagnosisFigures(msgspec.Struct):
    """Diagnosis of one object, read from its entry."""

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

    def _mean(self, values: NDArray) -> float:
        known, weights = np.isfinite(values), numbers(self.fraction)
        return float(np.average(values[known], weights=weights[known])) if weights[known].any() else float("nan")


def read_diagnosis(plain: Any, first_unseen: int) -> DiagnosisFigures | None:
    """What :meth:`Diagnosis.summary` returned, as figures; None if it is missing or malformed."""
    try:
        found = msgspec.convert(plain, DiagnosisFigures)
    except msgspec.ValidationError:
        return None
    found.first_unseen = first_unseen
    size = len(found.frequency), len(found.fraction), len(found.fraction)
    sizes = {(len(m.spectrum), len(m.frequencies), len(m.dampings)) for m in found.rows.values()}
    return found if TRUTH in found.rows and sizes == {size} and all(size) else None


def numbers(values: Sequence[Number]) -> NDArray:
    """The figures as an array, with NaN for undefined ones."""
    return np.array(values, float)
