"""Verdict on a method's predictions of an object: key figures and two sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from gausim.results.curves import BALLISTIC, ERROR_3D, FOLLOW_HANDS
from gausim.results.pivot import Pivot
from gausim.results.summary import MOTION_ENERGY, RATIO
from gausim.results.table import STATIC, ObjectInfo, Results

# What the references predict, in words.
NAMES = {STATIC: "no motion", BALLISTIC: "rigid flight", FOLLOW_HANDS: "the hands' motion alone"}
# Error relative to the reference's from which a prediction counts as useless.
NO_BETTER = 0.9
# Upper limits and words, for the error over the reference's and for predicted over true energy.
_FORESIGHT = (
    (0.2, "it predicts the motion closely"),
    (0.5, "it predicts most of the motion"),
    (NO_BETTER, "it predicts part of the motion"),
    (1.1, "that is no better than predicting {reference}"),
    (math.inf, "that is worse than predicting {reference}"),
)
_LIVELINESS = (
    (0.1, "it all but stands still"),
    (0.5, "it is much stiller than the object"),
    (0.8, "it dies down sooner than the object does"),
    (1.25, "it is about as lively as the object"),
    (2.0, "it is livelier than the object"),
    (math.inf, "it gains energy that the object does not have"),
)
_EVALUATE = "`gausim evaluate RUN` measures it."


@dataclass(frozen=True)
class Outcome:
    """Figures of the sentences: means over seeds, None where unknown."""

    frames: tuple[int, int] | None  # first and last unseen frame; None if the recordings end before
    measured: str  # kind of the errors: points (3D), or train (l2 of the images in the training views)
    error: float | None  # on unseen frames, over the reference's
    seen_error: float | None  # the same on seen frames
    energy: float | None  # predicted over true motion energy on unseen frames
    seeds: int  # number of evaluations
    repeats: bool  # whether the method repeats its fitted motion instead of extrapolating
    reference: str  # what the reference predicts, in words

    @property
    def merit(self) -> float:
        """Sort key of runs: the error on unseen frames, or on seen ones without these; unknown errors come last."""
        known = self.error if self.frames is not None else self.seen_error
        return math.inf if known is None else known


def outcome(pivot: Pivot, name: str, row: str, info: ObjectInfo, method: str | None = None) -> Outcome:
    """The outcome of a row on an object, over its seeds; ``method`` is its name in the facts of the object."""

    def mean(own: str, split: str, views: str, metric: str) -> float | None:
        return pivot.number(own, (name, split, views, metric))

    split = "unseen" if "unseen" in info.splits else "seen"
    start, stop = info.splits.get("unseen", (0, 0))
    in_3d = any(mean(row, part, "points", ERROR_3D + RATIO) is not None for part in ("seen", "unseen"))
    measured, ratio = ("points", ERROR_3D + RATIO) if in_3d else ("train", "l2" + RATIO)
    cell = pivot.cell(row, (name, split, measured, ratio))
    return Outcome(
        frames=(start, stop - 1) if stop else None,
        measured=measured,
        error=mean(row, "unseen", measured, ratio),
        seen_error=mean(row, "seen", measured, ratio),
        energy=mean(row, split, measured, MOTION_ENERGY),
        seeds=1 if cell is None else len(cell.seeds),
        repeats=info.repeats(method or row),
        reference=NAMES.get(info.reference, info.reference),
    )


def sentences(found: Outcome) -> tuple[str, str]:
    """Two sentences on the prediction: its error, and its motion energy."""
    return _error(found), _energy(found)


def _error(found: Outcome) -> str:
    over = f"; mean of {found.seeds} seeds" if found.seeds > 1 else ""
    seen = found.seen_error
    if found.frames is None:
        begin = "The recordings end with the frames trained on, so nothing is known of frames never seen"
        return f"{begin}." if seen is None else f"{begin}; on the frames seen, {_off(found, seen)}."
    frames = f"On frames never seen ({found.frames[0]}–{found.frames[1]}{over})"
    if found.error is None:
        return f"{frames}, nothing says how far off it is beside a model that predicts {found.reference}: {_EVALUATE}"
    aside = "" if seen is None else f" ({seen:.2f} on the frames it was trained on)"
    return f"{frames}, {_off(found, found.error)}{aside}: {_foresight(found)}."


def _off(found: Outcome, error: float) -> str:
    what, how = ("points", "") if found.measured == "points" else ("images in the training views", " (l2)")
    return f"its {what} are {error:.2f} times as far off{how} as those of a model that predicts {found.reference}"


def _foresight(found: Outcome) -> str:
    assert found.error is not None
    if found.repeats:
        return "it does not extrapolate, but repeats what was fitted to the frames it was trained on"
    words = _words(_FORESIGHT, found.error).format(reference=found.reference)
    if found.error < NO_BETTER or found.seen_error is None:
        return words
    learned = found.seen_error < NO_BETTER
    return words + (", although it learned the frames it was trained on" if learned else ", and it learned no more of "
                    "the frames it was trained on")  # fmt: skip


def _energy(found: Outcome) -> str:
    if found.energy is None:
        return f"Nothing says how lively its motion is: {_EVALUATE}"
    words = _words(_LIVELINESS, found.energy)
    if 0.8 <= found.energy < 1.25 and found.merit >= NO_BETTER:
        words = "it moves as much as the object, but not as the object does"
    return f"Its motion there has {found.energy:.2f} times the energy of the true motion: {words}."


def _words(scale: Sequence[tuple[float, str]], value: float) -> str:
    """The words for a figure, rounded as printed."""
    return next(words for end, words in scale if round(value, 2) < end)


def first_sentences(results: Results) -> list[str]:
    """One sentence per object of an evaluation on the error of its first method in unseen frames."""
    pivot = Pivot(results)
    return [
        f"{name}: {sentences(outcome(pivot, name, info.methods[0], info))[0]}" for name, info in results.objects.items()
    ]
