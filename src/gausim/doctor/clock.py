"""Synchronisation: whether the cameras show the same motion in the same frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gausim.doctor.evidence import Evidence, Watched
from gausim.doctor.finding import Finding

NAME = "clock"
# Frames by which a camera may be early or late.
FURTHEST = 8
# Correlation that a shift must reach, and gain over no shift, of several sequences together and of one alone.
_REACHED, _GAIN = 0.5, 0.25
_REACHED_ALONE, _GAIN_ALONE = 0.65, 0.5
# A camera whose motion correlates less than this with the others' cannot be placed.
_UNLIKE = 0.3
# Frames below which nothing can be correlated.
_FEW = 2 * FURTHEST


def find_clock_faults(evidence: Evidence) -> Iterator[Finding]:
    """Correlates every camera's motion energy over time with that of the others."""
    energies = [motion_energy(item) for item in evidence.watched if len(item.alpha) >= _FEW]
    if not energies or len(evidence.views) < 2 or max(float(e.max()) for e in energies) == 0:
        return
    lags, unsure = _lags(energies, _REACHED, _GAIN)
    for view in (evidence.views[v] for v in unsure):
        yield Finding(
            NAME, "note", "possible",
            f"Whether {view} is in step with the other cameras cannot be told: its motion over time is unlike theirs.",
            "Compare it by eye in motion.png (--out DIR).", {"view": view},
        )  # fmt: skip
    if any(lags.values()):
        yield from _told(evidence, lags, [item.name for item in evidence.watched])
        return
    for item, energy in zip((i for i in evidence.watched if len(i.alpha) >= _FEW), energies, strict=True):
        alone, _ = _lags([energy], _REACHED_ALONE, _GAIN_ALONE)
        if any(alone.values()):
            yield from _told(evidence, alone, [item.name])


def motion_energy(item: Watched) -> np.ndarray:
    """Mean change of colour and alpha from frame to frame over the foreground of both, (F - 1, V), 0 to 1."""
    change = np.empty((len(item.rgb) - 1, item.rgb.shape[1]))
    for f in range(len(change)):
        moved = np.abs(item.rgb[f + 1].astype(np.int16) - item.rgb[f]).mean(-1)
        moved = moved + np.abs(item.alpha[f + 1].astype(np.int16) - item.alpha[f])
        shown = (item.alpha[f + 1] > 0) | (item.alpha[f] > 0)
        change[f] = (moved * shown).sum((-1, -2)) / np.maximum(shown.sum((-1, -2)), 1) / 255
    return change


def correlations(energies: Sequence[np.ndarray], view: int, lags: dict[int, int]) -> np.ndarray:
    """Correlation of a view's energy with the mean of the others', by lag from -FURTHEST to FURTHEST (late: positive).

    Args:
        energies: (F - 1, V) of each sequence.
        view: which.
        lags: by how much views are late, as far as known.
    """
    found = np.zeros(2 * FURTHEST + 1)
    for energy in energies:
        z = (energy - energy.mean(0)) / (energy.std(0) + 1e-12)
        others = np.mean([np.roll(z[:, v], -lags.get(v, 0)) for v in range(z.shape[1]) if v != view], axis=0)
        count = len(z)
        for i, lag in enumerate(range(-FURTHEST, FURTHEST + 1)):
            own = z[max(0, lag) : count + min(0, lag), view]
            theirs = others[max(0, -lag) : count + min(0, -lag)]
            own, theirs = own - own.mean(), theirs - theirs.mean()
            found[i] += (own @ theirs) / (np.sqrt((own @ own) * (theirs @ theirs)) + 1e-12) / len(energies)
    return found


def _lags(energies: Sequence[np.ndarray], reached: float, gain: float) -> tuple[dict[int, int], list[int]]:
    """By how many frames each view is late; the one that gains most by a shift is shifted first, then the next."""
    views = energies[0].shape[1]
    lags = dict.fromkeys(range(views), 0)
    for _ in range(max(1, views - 1)):
        curves = {v: correlations(energies, v, lags) for v in range(views) if lags[v] == 0}
        gains = {v: float(c.max() - c[FURTHEST]) for v, c in curves.items() if c.max() >= reached}
        best = max(gains, key=lambda v: gains[v], default=None)
        if best is None or gains[best] < gain:
            break
        lags[best] = int(curves[best].argmax()) - FURTHEST
        if views == 2:
            break
    unsure = [v for v in range(views) if lags[v] == 0 and correlations(energies, v, lags).max() < _UNLIKE]
    return lags, unsure


def _told(evidence: Evidence, lags: dict[int, int], sequences: list[str]) -> Iterator[Finding]:
    place = f"in {sequences[0]}" if len(sequences) == 1 else f"in all {len(sequences)} sequences that were looked at"
    for v, lag in lags.items():
        if lag == 0:
            continue
        view, frames = evidence.views[v], f"{abs(lag)} frame{'s' if abs(lag) > 1 else ''}"
        against = "the other cameras" if len(evidence.views) > 2 else "the other camera (or that one is wrong)"
        cut = (
            f"drop the first {frames} of {view}" if lag > 0 else f"drop the first {frames} of all cameras but {view}, "
            f"or give {view} back the {frames} that were cut from its start"
        )  # fmt: skip
        yield Finding(
            NAME, "fault", "likely",
            f"{view} is out of step: it shows the motion {frames} {'later' if lag > 0 else 'earlier'} than {against}, "
            f"{place}.",
            f"Number the frames again: {cut}, and cut all cameras to one length. With films: `python -m "
            "data_prep.ingest` with sound, a flash or `--offsets`.",
            {"view": view, "late_by_frames": lag, "sequences": sequences},
        )  # fmt: skip
