"""One sentence on a method's predictions of an object, and the order of runs."""

import math

from gausim.results.curves import ERROR_3D
from gausim.results.pivot import Pivot
from gausim.results.summary import MOTION_ENERGY, RATIO
from gausim.results.table import ObjectInfo, Results


def merit(pivot: Pivot, name: str, row: str, info: ObjectInfo) -> float:
    """Error of a row over the reference's in unseen frames, in seen ones where there are no others; inf if unknown."""
    split, views, metric = _measured(pivot, name, row, info)
    found = pivot.number(row, (name, split, views, metric))
    return math.inf if found is None else found


def sentence(pivot: Pivot, name: str, row: str, info: ObjectInfo, method: str | None = None) -> str:
    """Errors and motion energy of a row on an object, over its seeds; ``method`` is its name in the object's facts."""
    split, views, metric = _measured(pivot, name, row, info)
    start, stop = info.splits[split]
    cell, seen = pivot.cell(row, (name, split, views, metric)), pivot.number(row, (name, "seen", views, metric))
    energy = pivot.number(row, (name, split, views, MOTION_ENERGY))
    what = "3D error" if views == "points" else "l2 in the training views"
    parts = ["the error is not known"]
    if cell is not None and cell.number is not None:
        parts = [f"{what} {cell.number:.2f} of the {info.reference} prediction's"]
        parts[0] += f" ({seen:.2f} in seen frames)" if seen is not None and split != "seen" else ""
    parts += [] if energy is None else [f"motion energy {energy:.2f} of the true motion's"]
    parts += [f"mean of {len(cell.seeds)} seeds"] if cell is not None and len(cell.seeds) > 1 else []
    told = f"{split.capitalize()} frames {start}–{stop - 1}: {', '.join(parts)}."
    repeats = info.repeats(row if method is None else method)
    return told + " The method repeats its fitted frames instead of extrapolating." * repeats


def first_sentences(results: Results) -> list[str]:
    """One sentence per object of an evaluation on its first method."""
    pivot = Pivot(results)
    return [f"{name}: {sentence(pivot, name, info.methods[0], info)}" for name, info in results.objects.items()]


def _measured(pivot: Pivot, name: str, row: str, info: ObjectInfo) -> tuple[str, str, str]:
    """Range of frames, views and metric by which a row is judged: in 3D where the true motion is known."""
    split = "unseen" if "unseen" in info.splits else "seen"
    known = any(pivot.cell(row, (name, part, "points", ERROR_3D + RATIO)) for part in ("seen", "unseen"))
    return (split, "points", ERROR_3D + RATIO) if known else (split, "train", "l2" + RATIO)
