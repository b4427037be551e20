"""Several cameras' films on one clock, and the frames of each that belong together.

``world time = time in the film + offset``. Offsets come from sound, a flash, or the user; the output's
frames are those of a reference camera, and every other camera gives its nearest frame. What remains between a frame and
its place is the residual; above half a frame there is a better frame, or none, and the films are refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from data_prep.capture.films.film import SOUND_RATE, Film, pictures, sound
from data_prep.capture.films.flash import RESOLUTION, brightness, flash_lag, flashes
from data_prep.capture.films.sound import sound_lag
from gausim.core import DataError

METHODS = ("audio", "flash", "offsets")
LIMIT = 0.5
# Rates are multiples of each other up to what quartz clocks differ by. 30 and 29.97 differ twice as much.
SAME_RATE = 5e-4


@dataclass(frozen=True)
class Offsets:
    """When the cameras began."""

    method: str  # how it is known
    seconds: Mapping[str, float]  # by camera, what is added to its film's times to be on the common clock [s]
    spread: Mapping[str, float]  # by camera, how far its measurements disagree with each other [s]
    resolution: Mapping[str, float]  # by camera, what the method can tell apart [s]
    notes: tuple[str, ...] = ()  # what the user should know


@dataclass(frozen=True, eq=False)
class Alignment:
    """Assignment of frames of several cameras to each other."""

    reference: str  # the camera whose frames give the output its times
    rate: Fraction  # output frames per second
    frames: Mapping[str, np.ndarray]  # by camera, the index in its film of each of the F output frames, int64
    # by camera, how much later than its place each of them is, float64 [output frames]
    residuals: Mapping[str, np.ndarray]

    @property
    def worst(self) -> float:
        """Largest residual of any camera [output frames]."""
        return max(float(np.abs(r).max()) for r in self.residuals.values())


def measure(films: Mapping[str, Film], method: str, *, given: Mapping[str, float]) -> Offsets:
    """Offsets by a method, or by the first that applies.

    Args:
        films: by camera.
        method: one of ``METHODS``, or ``auto``: sound, else a flash, else what is given.
        given: by camera, offsets that the user states [s]; cameras that are not named have 0.
    """
    if len(films) == 1:
        zero = dict.fromkeys(films, 0.0)
        return Offsets("single", zero, zero, zero)
    if method != "auto":
        return _by(method, films, given)
    reasons = []
    for name in METHODS:
        try:
            return _by(name, films, given)
        except DataError as error:
            reasons.append(f"{name}: {error}")
    raise DataError("these films cannot be synchronised.\n  " + "\n  ".join(reasons))


def align(
    films: Mapping[str, Film], offsets: Offsets, *, rate: Fraction | None = None, reference: str | None = None,
    start: float = 0.0, duration: float | None = None,
) -> Alignment:  # fmt: skip
    """Nearest frames of all cameras on the times of one.

    Args:
        films: by camera.
        offsets: when they began.
        rate: output frames per second; that of the slowest camera when None.
        reference: whose frames give the times; of the slowest cameras the one with the smallest residuals when None.
        start: time left out at the beginning of the common interval [s].
        duration: how much of it is kept [s]; all when None.
    """
    rate = rate or min(film.rate for film in films.values())
    steps = {name: _step(name, film, rate) for name, film in films.items()}
    for name, film in films.items():
        if offsets.spread[name] * float(rate) > LIMIT:
            raise DataError(
                f"{name} ({film.path.name}): its flashes disagree by {offsets.spread[name] * float(rate):.2f} frames, "
                f"allowed {LIMIT:g}: frames are missing. Cut the film shorter, or choose another --sync."
            )
    candidates = [reference] if reference else [name for name in films if steps[name] == min(steps.values())]
    window = _common(films, offsets, rate, start)
    most = None if duration is None else max(1, round(duration * float(rate)))
    found = [_aligned(films, offsets, rate, name, window, steps, most) for name in candidates]
    best = min(found, key=lambda a: round(a.worst, 6))
    for name, residual in best.residuals.items():
        worst = int(np.abs(residual).argmax())
        if abs(residual[worst]) > LIMIT + _rounding(films[name], rate):
            shortest, longest = (1000 * interval for interval in films[name].intervals)
            raise DataError(
                f"{name} ({films[name].path.name}): output frame {worst}: its nearest ({best.frames[name][worst]}) is "
                f"{residual[worst]:+.2f} frames from its place on the times of {best.reference}, allowed {LIMIT:g}. "
                f"Check its offset and rate. If the rate varies or frames are missing (they come {shortest:.1f} to "
                f"{longest:.1f} ms apart), cut the film before the gap (--start, --duration)."
            )
    return best


def _by(method: str, films: Mapping[str, Film], given: Mapping[str, float]) -> Offsets:
    zero = dict.fromkeys(films, 0.0)
    if method == "audio":
        return _by_sound(films)
    if method == "flash":
        return _by_flash(films)
    if not given:
        raise DataError("no offsets are given. Name them: --offsets cam_1=0.146,cam_2=-3f (seconds, or frames with f).")
    return Offsets("offsets", {**zero, **given}, zero, zero)


@contextmanager
def _naming(name: str, films: Mapping[str, Film], base: str | None = None) -> Iterator[None]:
    """Puts the camera, and the one that it is compared with, before an error."""
    try:
        yield
    except DataError as error:
        other = f" against {base} ({films[base].path.name})" if base else ""
        raise DataError(f"{name} ({films[name].path.name}){other}: {error}") from error


def _by_sound(films: Mapping[str, Film]) -> Offsets:
    for name, film in films.items():
        if not film.sound:
            raise DataError(f"{name} ({film.path.name}): has no sound.")
    (base, reference), *others = films.items()
    first, begin = sound(reference)
    seconds, notes = {base: 0.0}, []
    for name, film in others:
        second, begins = sound(film)
        with _naming(name, films, base):
            lag = sound_lag(first, second, SOUND_RATE)
        seconds[name] = lag.seconds + begin - begins
        notes.append(f"{name}: sharpness {lag.sharpness:.1f}, likeness of loudness {lag.likeness:.2f}")
    notes.append("sound travels 1 m in 2.9 ms: a microphone that is further from the source hears later")
    return Offsets("audio", seconds, dict.fromkeys(films, 0.0), dict.fromkeys(films, 1 / SOUND_RATE), tuple(notes))


def _by_flash(films: Mapping[str, Film]) -> Offsets:
    found: dict[str, list[float]] = {}
    for name, film in films.items():
        with _naming(name, films):
            levels = np.full(len(film), np.nan)
            for i, frame in pictures(film):
                levels[i] = brightness(frame.to_ndarray(format="gray"))
            found[name] = flashes(levels, film.times, interval=1 / float(film.rate))
    (base, reference), *others = films.items()
    seconds, spread = {base: 0.0}, {base: 0.0}
    for name, film in others:
        with _naming(name, films, base):
            interval = 1 / float(min(film.rate, reference.rate))
            seconds[name], spread[name] = flash_lag(found[base], found[name], interval=interval)
    return Offsets("flash", seconds, spread, {name: RESOLUTION / float(film.rate) for name, film in films.items()})


def _step(name: str, film: Film, rate: Fraction) -> int:
    ratio, unsure = float(film.rate / rate), 2 * film.jitter / float(film.times[-1] - film.times[0])
    step = round(ratio)
    if step < 1 or abs(ratio / step - 1) > SAME_RATE + unsure:
        raise DataError(
            f"{name} ({film.path.name}): {float(film.rate):.6g} frames per second are no whole multiple of the "
            f"output's {float(rate):.6g}. Film all cameras at one rate, or at multiples of one, or "
            "convert this film first."
        )
    return step


def _common(films: Mapping[str, Film], offsets: Offsets, rate: Fraction, start: float) -> tuple[float, float]:
    """Begin and end of the time that all cameras saw, within half an output frame [s]."""
    half = LIMIT / float(rate)
    begins = {name: float(film.times[0]) + offsets.seconds[name] for name, film in films.items()}
    ends = {name: float(film.times[-1]) + offsets.seconds[name] for name, film in films.items()}
    last, first = max(begins, key=begins.__getitem__), min(ends, key=ends.__getitem__)
    begin, end = begins[last] + start, ends[first]
    if begin > end + half:
        what = f"after leaving out {start:g} s" if begins[last] <= ends[first] else f"by {offsets.method}"
        raise DataError(
            f"{last} ({films[last].path.name}) begins {begins[last] - ends[first]:+.3f} s after {first} "
            f"({films[first].path.name}) ended, {what}: the films have no time in common. Check the films and offsets."
        )
    return begin - half, end + half


def _aligned(
    films: Mapping[str, Film], offsets: Offsets, rate: Fraction, reference: str, window: tuple[float, float],
    steps: Mapping[str, int], most: int | None,
) -> Alignment:  # fmt: skip
    world = {name: film.times + offsets.seconds[name] for name, film in films.items()}
    own, slack = world[reference], 1e-6 / float(rate)
    inside = own[(own >= window[0] - slack) & (own <= window[1] + slack)]
    if not len(inside):
        raise DataError(
            f"{reference}: has no frame between {window[0]:.3f} s and {window[1]:.3f} s. Choose a longer part."
        )
    count = int(np.floor((inside[-1] - inside[0]) * float(rate) + 1e-3)) + 1
    count = min(count, most or count)
    grid = inside[0] + np.arange(count) / float(rate)
    frames, residuals = {}, {}
    for name, times in world.items():
        frames[name] = _nearest(times, grid, steps[name], (LIMIT + _rounding(films[name], rate)) / float(rate))
        residuals[name] = (times[frames[name]] - grid) * float(rate)
    return Alignment(reference, rate, frames, residuals)


def _nearest(times: np.ndarray, grid: np.ndarray, step: int, within: float) -> np.ndarray:
    """Indices of the frames nearest to the grid; evenly spaced ones where these do as well."""
    right = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    nearest = np.where(grid - times[right - 1] <= times[right] - grid, right - 1, right)
    # Half a frame off, rounded time stamps would make the nearest frame alternate between two neighbours.
    even = nearest[0] + step * np.arange(len(grid))
    if even[-1] < len(times) and np.abs(times[even] - grid).max() <= within:
        return np.asarray(even)
    return np.asarray(nearest)


def _rounding(film: Film, rate: Fraction) -> float:
    """Largest residual caused by the container's rounding of time stamps [output frames]."""
    return 1e-6 + 0.5 * float(film.time_base * rate)


def facts(film: Film, name: str, offsets: Offsets, alignment: Alignment) -> dict[str, Any]:
    """Entry of one camera in the manifest, as plain data."""
    residual, frames, rate = alignment.residuals[name], alignment.frames[name], float(film.rate)
    later = offsets.seconds[name] - offsets.seconds[alignment.reference]
    return {
        "fps": rate, "variable_rate": film.variable, "frames": len(film), "size": list(film.size),
        "rotation": film.rotation, "codec": film.codec, "offset_seconds": later, "offset_frames": later * rate,
        "resolution_frames": offsets.resolution[name] * rate, "disagreement_frames": offsets.spread[name] * rate,
        "residual_frames": {"mean": float(residual.mean()), "largest": float(np.abs(residual).max())},
        "kept": [int(frames[0]), int(frames[-1])], "left_out": [int(frames[0]), int(len(film) - 1 - frames[-1])],
        "repeated": int((np.diff(frames) == 0).sum()),
    }  # fmt: skip
