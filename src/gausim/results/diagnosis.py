"""Diagnosis of predictions whose true motion is known: frequency, damping, phase and first velocity."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

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
from gausim.results.curves import TRUTH

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
        """The diagnosis as plain data (see :mod:`gausim.results.summary`), or None if no sequence moves."""
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
                "frequencies": [_finite(ring.frequency) for ring in rings],
                "dampings": [_finite(ring.damping) for ring in rings],
            }
            if name != TRUTH:
                row["phase_error"] = [_finite(v) for v in phase_error(series, truth)]
                row["velocity_cosine"] = _mean(
                    [velocity_cosine(p, t) for p, t in zip(motions, self._truth, strict=True)]
                )
            if name in self._levels:
                row["level_errors"] = [_finite(own / still if still else math.nan) for own, still in self._levels[name]]
            found["frequency"] = frequency.tolist()
            found["rows"][name] = row
        return found


def _thin(displacement: Tensor, every: int) -> NDArray:
    return displacement[:, ::every].detach().cpu().float().numpy()


def _mean(values: Sequence[float]) -> float | None:
    known = [v for v in values if math.isfinite(v)]
    return sum(known) / len(known) if known else None


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
