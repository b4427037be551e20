"""Time offset between two cameras, by the sound that both microphones recorded.

Loudness over time (its logarithm, in a band that every camera records) tells where the recordings belong, and the
correlation of the whitened sound itself (Knapp and Carter, 1976) places them to a small part of a millisecond.

Sound travels 1 m in 2.9 ms: a microphone 3 m further away hears half a frame later at 50 frames per second. Keep the
clap near the object and the microphones at the cameras about equally far from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, rfft
from scipy.signal import butter, correlate, correlation_lags, find_peaks, sosfiltfilt

from gausim.core import DataError

# Cameras' microphones and lossy codecs agree on this band [Hz].
BAND = (150.0, 4000.0)
ENVELOPE_RATE = 500
# Candidates closer than this are one [s].
APART = 0.05
# The two sounds must overlap by so much [s].
LEAST_OVERLAP = 0.4
# Peak of the whitened correlation over the standard deviation of the rest: noise reaches 5 on thousands of lags.
SHARP = 9.0
# How much more the best candidate must stand out than the next: in sharpness, in likeness of loudness.
CLEARER, LOUDER = 1.4, 1.2
LIKE = 0.5
CANDIDATES = 8


@dataclass(frozen=True)
class Lag:
    """A measured difference of starts."""

    seconds: float  # by how much the second recording's start is later than the first's [s]
    sharpness: float  # of the whitened correlation's peak, in standard deviations of the rest
    likeness: float  # correlation coefficient of the loudness


def sound_lag(first: np.ndarray, second: np.ndarray, rate: int) -> Lag:
    """By how much the second recording began later than the first."""
    a, b = _band(first, rate, "the reference"), _band(second, rate, "it")
    loud_a, loud_b = _loudness(a, rate), _loudness(b, rate)
    scores, lags = correlate(loud_a, loud_b), correlation_lags(len(loud_a), len(loud_b))
    least = int(LEAST_OVERLAP * ENVELOPE_RATE)
    enough = (lags >= least - len(loud_b)) & (lags <= len(loud_a) - least)
    scores, lags = scores[enough] / np.sqrt((loud_a**2).sum() * (loud_b**2).sum() + 1e-24), lags[enough]
    peaks, _ = find_peaks(np.pad(scores, 1, constant_values=-1), distance=int(APART * ENVELOPE_RATE))
    best = sorted(peaks - 1, key=lambda i: -scores[i])[:CANDIDATES]
    if not best:
        raise DataError("its sound is as loud all the time; it cannot be aligned.")
    whitened = correlate(_white(a), _white(b))
    found = [_placed(whitened, len(b), lags[i] / ENVELOPE_RATE, float(scores[i]), rate) for i in best]
    for name, needed, clearer in (("sharpness", SHARP, CLEARER), ("likeness", LIKE, LOUDER)):
        ranked = sorted(found, key=lambda lag: -getattr(lag, name))
        values = [getattr(lag, name) for lag in ranked] + [0.0]
        if values[0] >= max(needed, clearer * values[1]):
            return ranked[0]
    raise DataError(
        "its sound does not fix its place in time: no place stands out, by the sound itself or by its loudness."
    )


def _band(samples: np.ndarray, rate: int, whose: str) -> np.ndarray:
    if len(samples) < LEAST_OVERLAP * rate:
        raise DataError(
            f"the sound of {whose} lasts {len(samples) / rate:.2f} s, expected at least {LEAST_OVERLAP:g} s."
        )
    high = min(BAND[1], 0.45 * rate)
    filtered = sosfiltfilt(butter(4, (BAND[0], high), "bandpass", fs=rate, output="sos"), samples.astype(np.float64))
    # -80 dB of full scale: below what any camera's own noise is.
    if not np.abs(filtered).max() > 1e-4:
        raise DataError(f"the sound of {whose} is silent.")
    return filtered


def _loudness(samples: np.ndarray, rate: int) -> np.ndarray:
    """Logarithm of the loudness at ``ENVELOPE_RATE``, without its mean."""
    block = rate // ENVELOPE_RATE
    power = (samples[: len(samples) // block * block].reshape(-1, block) ** 2).mean(1)
    # Quiet passages differ between microphones by their noise: everything 40 dB below the loudest is one quiet.
    level = np.log(power + 1e-4 * np.quantile(power, 0.999) + 1e-20)
    return level - level.mean()


def _white(samples: np.ndarray) -> np.ndarray:
    """Sound with equal parts of all frequencies that are in it, so that its echoes do not hide its place."""
    spectrum = rfft(samples)
    size = np.abs(spectrum)
    return irfft(np.where(size > 1e-3 * size.max(), spectrum / np.maximum(size, 1e-300) ** 0.5, 0), len(samples))


def _placed(whitened: np.ndarray, length: int, lag: float, likeness: float, rate: int) -> Lag:
    """A coarse lag [s], refined by the correlation around it."""
    zero, reach = length - 1 + round(lag * rate), int(APART * rate)
    low, high = max(0, zero - reach), min(len(whitened), zero + reach + 1)
    around = whitened[low:high]
    top = int(np.argmax(around))
    noise = float(around[np.abs(np.arange(len(around)) - top) > 0.001 * rate].std())
    place = low + top + parabola_peak(around, top) - (length - 1)
    return Lag(place / rate, float(around[top]) / max(noise, 1e-300), likeness)


def parabola_peak(values: np.ndarray, top: int) -> float:
    """Position of the maximum at index ``top`` between its neighbours, in −0.5..0.5 of a sample."""
    if not 0 < top < len(values) - 1:
        return 0.0
    left, middle, right = (float(values[top + i]) for i in (-1, 0, 1))
    curve = left - 2 * middle + right
    return float(np.clip(0.5 * (left - right) / curve, -0.5, 0.5)) if curve < 0 else 0.0
