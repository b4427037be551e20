"""Time offset between two cameras, by the sound that both microphones recorded.

Loudness over time (its logarithm, in a band that every camera records) gives candidates; generalised
cross-correlation with phase transform (Knapp and Carter, 1976) on windows of the sound itself places them to a small
part of a millisecond and tells them apart. Several windows along the film show whether the clocks run apart.

Sound travels 1 m in 2.9 ms: a microphone 3 m further away hears half a frame later at 50 frames per second. Keep the
clap near the object and the microphones at the cameras about equally far from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.signal import butter, correlate, correlation_lags, find_peaks, sosfiltfilt
from scipy.signal.windows import tukey

from gausim.core import DataError

# Cameras' microphones and lossy codecs agree on this band [Hz].
BAND = (150.0, 4000.0)
ENVELOPE_RATE = 500
# Candidates closer than this are one [s].
APART = 0.05
CANDIDATES = 8
WINDOWS = 5
WINDOW_SECONDS = 8.0
# The two sounds must overlap by so much [s].
LEAST_OVERLAP = 0.4
# Peak of the phase transform over the standard deviation of the rest: noise reaches 5 on thousands of lags.
SHARP, USABLE = 9.0, 6.0
# How much more the best candidate must stand out than the next: in sharpness, in likeness of loudness.
CLEARER, LOUDER = 1.4, 1.2
LIKE = 0.5


@dataclass(frozen=True)
class Lag:
    """A measured difference of starts."""

    seconds: float  # by how much the second recording's start is later than the first's [s]
    spread: float  # largest disagreement between parts of the film [s]
    sharpness: float  # of the phase transform's peak, in standard deviations of the rest
    likeness: float  # correlation coefficient of the loudness


def sound_lag(first: np.ndarray, second: np.ndarray, rate: int) -> Lag:
    """By how much the second recording began later than the first.

    Raises:
        DataError: one is silent, they are too short, or do not tell where they belong.
    """
    a, b = _band(first, rate, "the reference"), _band(second, rate, "it")
    envelope_a, envelope_b = _loudness(a, rate), _loudness(b, rate)
    scores, lags = _likeness(envelope_a, envelope_b)
    distance = int(APART * ENVELOPE_RATE)
    peaks, _ = find_peaks(np.concatenate([[-1.0], scores, [-1.0]]), distance=distance)
    peaks = sorted(peaks - 1, key=lambda i: -scores[i])[:CANDIDATES]
    if not peaks:
        raise DataError("its sound is as loud all the time; nothing tells where it belongs.")
    return _clearest([Lag(*_refined(a, b, lags[i] / ENVELOPE_RATE, rate), float(scores[i])) for i in peaks])


def _clearest(found: list[Lag]) -> Lag:
    """The candidate that stands out, by the sound itself or by its loudness."""
    sharp = max(found, key=lambda lag: lag.sharpness)
    blunter = max((lag.sharpness for lag in found if abs(lag.seconds - sharp.seconds) > APART), default=0.0)
    if sharp.sharpness >= SHARP and sharp.sharpness >= CLEARER * blunter:
        return sharp
    like = found[0]
    less_like = max((lag.likeness for lag in found if abs(lag.seconds - like.seconds) > APART), default=0.0)
    if like.likeness >= LIKE and like.likeness >= LOUDER * less_like:
        return like
    raise DataError(
        f"its sound does not tell where it belongs (sharpness {sharp.sharpness:.1f}, needed {SHARP:g} and {CLEARER:g} "
        f"times the next, {blunter:.1f}; likeness of loudness {like.likeness:.2f}, needed {LIKE:g} and "
        f"{LOUDER:g} times the next, {less_like:.2f})."
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


def _likeness(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of two signals over all lags with enough overlap, relative to their common energy."""
    products, lags = correlate(a, b, method="fft"), correlation_lags(len(a), len(b))
    least = int(LEAST_OVERLAP * ENVELOPE_RATE)
    enough = (lags >= least - len(b)) & (lags <= len(a) - least)
    norm = np.sqrt((a**2).sum() * (b**2).sum())
    return products[enough] / max(norm, 1e-12), lags[enough]


def _refined(a: np.ndarray, b: np.ndarray, lag: float, rate: int) -> tuple[float, float, float]:
    """The lag [s], its spread over windows [s], and the median sharpness, around a coarse lag [s]."""
    shift = round(lag * rate)
    begin, end = max(0, shift), min(len(a), len(b) + shift)
    length = min(end - begin, int(WINDOW_SECONDS * rate))
    starts = np.unique(np.linspace(begin, end - length, min(WINDOWS, (end - begin) // length)).astype(int))
    reach = int(APART * rate)
    parts = [_phase_peak(a[s : s + length], b[s - shift : s - shift + length], reach, rate) for s in starts]
    # Silent windows say nothing: only those count that are about as sharp as the best.
    sharpest = max(sharp for _, sharp in parts)
    kept = [(delay, sharp) for delay, sharp in parts if sharp >= max(USABLE, 0.5 * sharpest)]
    if not kept:
        return lag, 0.0, sharpest
    delays = np.array([delay for delay, _ in kept])
    middle, spread = float(np.median(delays)), float(np.ptp(delays))
    return (shift + middle) / rate, spread / rate, float(np.median([sharp for _, sharp in kept]))


def _phase_peak(a: np.ndarray, b: np.ndarray, reach: int, rate: int) -> tuple[float, float]:
    """Delay of ``a`` behind ``b`` [samples] within ±reach, to a fraction, and the peak's sharpness."""
    size = next_fast_len(2 * len(a))
    # Cut edges sound alike in every recording, so windows fade in and out, and only the band of the filter counts.
    fade = tukey(len(a), 0.25)
    cross = rfft(a * fade, size) * np.conj(rfft(b * fade, size))
    magnitude = np.abs(cross)
    frequency = rfftfreq(size, 1 / rate)
    heard = (frequency >= BAND[0]) & (frequency <= BAND[1]) & (magnitude > 1e-6 * magnitude.max(initial=0.0))
    weight = np.where(heard, 1 / np.maximum(magnitude, 1e-300), 0.0)
    correlation = irfft(cross * weight, size)
    around = correlation[np.arange(-reach, reach + 1) % size]
    top = int(np.argmax(around))
    beside = np.abs(np.arange(len(around)) - top) > 0.001 * rate
    noise = float(around[beside].std())
    if not noise > 0:
        return 0.0, 0.0
    return top - reach + parabola_peak(around, top), float(around[top] / noise)


def parabola_peak(values: np.ndarray, top: int) -> float:
    """Position of the maximum at index ``top`` between its neighbours, in −0.5..0.5 of a sample."""
    if not 0 < top < len(values) - 1:
        return 0.0
    left, middle, right = (float(values[top + i]) for i in (-1, 0, 1))
    curve = left - 2 * middle + right
    return float(np.clip(0.5 * (left - right) / curve, -0.5, 0.5)) if curve < 0 else 0.0
