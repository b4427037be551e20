"""Check of synchronisation: whether the cameras show the same motion in the same frame."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gausim.core import Cameras
from gausim.doctor.coverage import view_directions
from gausim.doctor.evidence import Evidence, Finding, Watched
from gausim.doctor.silhouettes import centres

# Largest tested shift of a camera [frames].
FURTHEST = 8
# Correlation that a shift must reach, and its gain over no shift, of several sequences together and of one alone.
_REACHED, _GAIN = 0.5, 0.25
_REACHED_ALONE, _GAIN_ALONE = 0.65, 0.5
# Largest tested shift as a fraction of the frames, of several sequences and of one alone: of the few frames that a
# larger one leaves in common, parts of a vibration correlate by chance.
_PART, _PART_ALONE = 0.375, 0.25
# The energy's phase depends on the view where the object moves in a circle, so the centres of the masks have equal
# weight if their correlation reaches this. Otherwise the shift is undetermined.
_TELLING = 0.5
# Overlap with the rest scene below which a camera's pose is not used.
_SOMEWHERE = 0.5
# Correlation with the other cameras' motion below which a camera's shift is undetermined.
_UNLIKE = 0.3
# Smallest number of frames for a correlation.
_FEW = 2 * FURTHEST


@dataclass(frozen=True, eq=False)
class _Series:
    """Motion of one sequence over time in each view."""

    name: str
    energy: np.ndarray  # (F - 1, V), see motion_energy
    middles: np.ndarray  # (F, V, 2) of the masks [reduced pixels]
    seen: np.ndarray  # (V, 2, 3) derivative of image by space coordinates at the object [reduced pixels per unit]


def find_clock_faults(evidence: Evidence) -> Iterator[Finding]:
    """Finds shifted cameras by the correlation of motion energy and of mask centres with the other cameras."""
    items = [item for item in evidence.watched if len(item.alpha) >= _FEW]
    series = [_Series(i.name, motion_energy(i), _middles(i), _jacobians(evidence, i.cameras)) for i in items]
    if not series or len(evidence.views) < 2 or max(float(s.energy.max()) for s in series) == 0:
        return
    if evidence.fits is not None and np.median([[f.overlap for f in row] for row in evidence.fits]) < _SOMEWHERE:
        yield Finding(
            "note", "Whether the cameras are synchronised was not checked: their poses are wrong.",
            "Mend the calibration and run this again.",
        )  # fmt: skip
        return
    lags, unsure = _lags(series, _REACHED, _GAIN)
    for view in (evidence.views[v] for v in sorted(unsure)):
        yield Finding(
            "note",
            f"Whether {view} is synchronised with the other cameras is undetermined: its motion is unlike theirs.",
            "Compare it by eye in motion.png (--out DIR).", (view,),
        )  # fmt: skip
    if any(lags.values()):
        yield from _findings(evidence, lags, [s.name for s in series])
        return
    for one in series:
        lags, _ = _lags([one], _REACHED_ALONE, _GAIN_ALONE)
        yield from _findings(evidence, lags, [one.name])


def motion_energy(item: Watched) -> np.ndarray:
    """Mean change of colour and alpha from frame to frame over the foreground of both, (F - 1, V), 0 to 1."""
    change = np.empty((len(item.rgb) - 1, item.rgb.shape[1]))
    for f in range(len(change)):
        moved = np.abs(item.rgb[f + 1].astype(np.int16) - item.rgb[f]).mean(-1)
        moved = moved + np.abs(item.alpha[f + 1].astype(np.int16) - item.alpha[f])
        shown = (item.alpha[f + 1] > 0) | (item.alpha[f] > 0)
        change[f] = (moved * shown).sum((-1, -2)) / np.maximum(shown.sum((-1, -2)), 1) / 255
    return change


def _energy_correlation(series: Sequence[_Series], view: int, lags: dict[int, int]) -> np.ndarray:
    """Correlation of a view's energy with the mean of the others', by lag from -FURTHEST to FURTHEST (late: positive).

    ``lags`` are the known delays of views [frames].
    """
    found = np.zeros(2 * FURTHEST + 1)
    for energy in (s.energy for s in series):
        z = (energy - energy.mean(0)) / (energy.std(0) + 1e-12)
        others = np.mean([np.roll(z[:, v], -lags[v]) for v in lags if v != view], axis=0)
        found += _by_lag(z[:, view, None], others[:, None], _furthest(series)) / len(series)
    return found


def _path_correlation(series: Sequence[_Series], view: int, lags: dict[int, int]) -> np.ndarray:
    """Correlation of a mask centre's path with its prediction from the other views, by lag.

    The path in each view is a linear image of one path in space, which is estimated from the other views by least
    squares.
    """
    found = np.zeros(2 * FURTHEST + 1)
    for s in series:
        others = [v for v in lags if v != view]
        moved = np.concatenate([np.roll(s.middles[:, v], -lags[v], axis=0) for v in others], axis=1)
        in_space = moved @ np.linalg.pinv(np.concatenate([s.seen[v] for v in others])).T
        found += _by_lag(s.middles[:, view], in_space @ s.seen[view].T, _furthest(series)) / len(series)
    return found


def _furthest(series: Sequence[_Series]) -> int:
    part = _PART if len(series) > 1 else _PART_ALONE
    return min(FURTHEST, int(part * min(len(s.middles) for s in series)))


def _by_lag(own: np.ndarray, theirs: np.ndarray, furthest: int) -> np.ndarray:
    """Correlation of two series (F, n), with the first one late by -FURTHEST to FURTHEST frames; 0 beyond furthest."""
    found, count = np.zeros(2 * FURTHEST + 1), len(own)
    for lag in range(-furthest, furthest + 1):
        a = own[max(0, lag) : count + min(0, lag)]
        b = theirs[max(0, -lag) : count + min(0, -lag)]
        a, b = a - a.mean(0), b - b.mean(0)
        found[FURTHEST + lag] = (a * b).sum() / (np.sqrt((a * a).sum() * (b * b).sum()) + 1e-12)
    return found


def _middles(item: Watched) -> np.ndarray:
    """Centres of the masks, (F, V, 2) [reduced pixels]; that of the frame before for an empty mask."""
    found, shown = centres(item.alpha), item.alpha.max((-1, -2)) > 0
    for f in range(1, len(found)):
        found[f] = np.where(shown[f, :, None], found[f], found[f - 1])
    return found


def _jacobians(evidence: Evidence, cameras: Cameras) -> np.ndarray:
    middle = view_directions(evidence)[1]
    rotations, lenses = cameras.viewmats[:, :3, :3].double().numpy(), cameras.Ks[:, :2, :2].double().numpy()
    x, y, z = (rotations @ middle + cameras.viewmats[:, :3, 3].double().numpy()).T
    z = np.where(np.abs(z) > 1e-6, z, 1e-6)
    one, zero = np.ones_like(z), np.zeros_like(z)
    projection = np.stack((np.stack((one, zero, -x / z), -1), np.stack((zero, one, -y / z), -1)), 1) / z[:, None, None]
    return lenses @ projection @ rotations


def _lags(series: Sequence[_Series], reached: float, gain: float) -> tuple[dict[int, int], set[int]]:
    """Delay of each view [frames], and the undetermined views.

    Views are shifted in the order of their gain, the largest first.
    """
    views = series[0].energy.shape[1]
    lags: dict[int, int] = dict.fromkeys(range(views), 0)
    settled: set[int] = set()
    unsure: set[int] = set()
    while len(settled) < views - (views == 2):
        scores = {v: _score(series, v, lags) for v in range(views) if v not in settled}
        gains = {v: float(c.max() - c[FURTHEST]) for v, (c, _) in scores.items() if c.max() >= reached}
        best = max(gains, key=lambda v: gains[v], default=None)
        if best is None or gains[best] < gain:
            break
        curve, telling = scores[best]
        settled.add(best)
        if telling:
            lags[best] = int(curve.argmax()) - FURTHEST
        else:
            unsure.add(best)
    unlike = {v for v in range(views) if v not in settled and _energy_correlation(series, v, lags).max() < _UNLIKE}
    return lags, unsure | unlike


def _score(series: Sequence[_Series], view: int, lags: dict[int, int]) -> tuple[np.ndarray, bool]:
    """Correlation of a view with the others by lag, and whether it includes the centres of the masks."""
    energy, path = _energy_correlation(series, view, lags), _path_correlation(series, view, lags)
    if path.max() < _TELLING:
        return energy, False
    # A shift that only the energy speaks for is the phase of a circle.
    return np.where(path >= path[FURTHEST], (energy + path) / 2, 0.0), True


def _findings(evidence: Evidence, lags: dict[int, int], sequences: list[str]) -> Iterator[Finding]:
    place = f"in {sequences[0]}" if len(sequences) == 1 else f"in all {len(sequences)} checked sequences"
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
            "fault",
            f"{view} is not synchronised: it shows the motion {frames} {'later' if lag > 0 else 'earlier'} than "
            f"{against}, {place}.",
            f"Number the frames again: {cut}, and cut all cameras to one length. With films: `gausim "
            "prepare ingest` with sound, a flash or `--offsets`.", (view,),
        )  # fmt: skip
