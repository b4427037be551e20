"""Oscillation of predictions and truth: frequencies, damping, spectrum and phase in the truth's principal motions.

Principal motions of the true displacements are the few orthogonal shapes with the largest squared displacement. A shape
is rarely one vibration mode, but the basis is the same for all predictions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import hilbert, periodogram

Array = NDArray[np.float64]


def principal_motions(displacements: Sequence[NDArray], count: int) -> tuple[Array, Array]:
    """The ``count`` first principal components of displacements (F, P, 3) from rest, over all sequences.

    Returns (M, 3 P) orthonormal shapes, and the fraction (M,) of the squared displacement in each, the largest
    first.
    """
    rows = np.concatenate([d.reshape(len(d), -1) for d in displacements]).astype(np.float64)
    values, vectors = np.linalg.eigh(rows @ rows.T)  # far fewer frames than coordinates
    total = max(float(values.sum()), np.finfo(float).tiny)
    chosen = [i for i in np.argsort(values)[::-1][:count] if values[i] > 1e-12 * total]
    shapes = (vectors[:, chosen] / np.sqrt(values[chosen])).T @ rows
    return shapes, values[chosen] / total


def coordinates(displacement: NDArray, shapes: Array) -> Array:
    """(F, M) coordinates of a sequence's displacements (F, P, 3) in the shapes."""
    return displacement.reshape(len(displacement), -1) @ shapes.T


@dataclass(frozen=True)
class Oscillation:
    """One damped oscillation."""

    frequency: float  # [Hz]; 0 for a motion that only decays
    damping: float  # fraction of critical damping; negative if the motion grows, NaN if it does not oscillate


def oscillation(series: Sequence[Array], fps: float) -> Oscillation:
    """Least-squares fit of z_{t+1} = a z_t + b z_{t-1} to the values (F,) of a coordinate in every sequence."""
    past = np.concatenate([np.stack((s[1:-1], s[:-2]), 1) for s in series])
    future = np.concatenate([s[2:] for s in series])
    if not np.abs(past).max(initial=0) > 0:
        return Oscillation(0.0, float("nan"))
    a, b = np.linalg.lstsq(past, future, rcond=None)[0]
    root = complex(np.roots([1.0, -a, -b])[0])
    if abs(root.imag) < 1e-12 or abs(root) == 0:
        return Oscillation(0.0, float("nan"))
    angle, decay = abs(np.angle(root)), -np.log(abs(root))
    return Oscillation(float(angle * fps / (2 * np.pi)), float(decay / np.hypot(angle, decay)))


def spectrum(series: Sequence[Array], fps: float) -> tuple[Array, Array]:
    """Frequencies (B,) [Hz] and the power (B,) of coordinates (F, M), summed over them, mean over sequences.

    Sequences are cut to the shortest, centred and multiplied by a Hann window.
    """
    length = min(len(s) for s in series)
    found = [periodogram(s[:length], fs=fps, window="hann", detrend="constant", axis=0) for s in series]
    return found[0][0], np.mean([power.sum(1) for _, power in found], axis=0)


def phase_error(prediction: Sequence[Array], truth: Sequence[Array]) -> Array:
    """Root-mean-square difference of phase (F,) [degrees] between coordinates (F, M), 104 where they are unrelated.

    The phase is that of the analytic signal; the weight of a coordinate in a frame is the product of both amplitudes.
    """
    length = min(len(t) for t in truth)
    squared, weights = np.zeros(length), np.zeros(length)
    for p, t in zip(prediction, truth, strict=True):
        a, b = (hilbert(x[:length] - x[:length].mean(0), axis=0) for x in (p, t))
        weight = np.abs(a) * np.abs(b)
        squared += (weight * np.degrees(np.angle(a * b.conj())) ** 2).sum(1)
        weights += weight.sum(1)
    return np.sqrt(np.divide(squared, weights, out=np.full(length, np.nan), where=weights > 0))


def velocity_cosine(prediction: NDArray, truth: NDArray) -> float:
    """Cosine of the angle between the first steps x_1 - x_0 of two motions (F, P, 3), over all their coordinates."""
    a, b = ((x[1] - x[0]).astype(np.float64).ravel() for x in (prediction, truth))
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0 else float("nan")
