"""Tables from ``metrics.json``: Markdown text, or headers and rows for other formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from gausim.metrics.lpips import NO_LPIPS, NO_WEIGHTS
from gausim.results.curves import ERROR_3D, STATIC, TRACK_ERROR
from gausim.results.summary import MOTION_ENERGY, dig

SPLIT_TITLES = {"seen": "seen", "unseen": "unseen", "unseen_near": "unseen, first", "unseen_all": "unseen, all"}
GROUP_TITLES = {"points": "3D, true points", "train": "training views", "heldout": "views never trained on"}
LEGEND = (
    "Mean ± standard deviation over sequences; `/ static` is the ratio to the static prediction (below 1 is better), "
    "`/ ballistic` and `/ follow hands` to rigid flight and to following the hands at once, of bodies that move so; "
    "motion energy is the predicted over the true one, all sequences together (1 is right, 0 stands still); floor is "
    "the reconstruction itself against frame 0. Images are foreground on black."
)
FLOOR_ROW = "floor"
NO_FORESIGHT = "Does not foresee: its frames after the trained ones repeat what was fitted."


class BounceFigure(NamedTuple):
    """How a figure of the first bounce is printed."""

    key: str  # in the entry ``bounce`` of ``metrics.json``
    head: str  # heading where the title names the unit
    label: str  # heading with the unit
    scale: float
    digits: int
    sign: str = ""  # after the figure


BOUNCE = (
    BounceFigure("height", "highest point", "highest point after the impact [scene units]", 1.0, 3),
    BounceFigure("height_error", "its error", "its error [%]", 100.0, 1, " %"),
    BounceFigure("rise", "rise", "rise [scene units]", 1.0, 3),
    BounceFigure("rise_error", "its error", "its error [%]", 100.0, 1, " %"),
    BounceFigure(
        "depth", "deepest below the floor [% of diagonal]", "deepest below the floor [% of the diagonal]", 1, 2
    ),
)
CONTRAST_HEAD = ("mean foreground colour", "its norm", "largest l2 of a pixel")


@dataclass(frozen=True)
class Table:
    """A table of text; ``breaks`` are the rows at which a new range of frames begins."""

    title: str
    head: list[str]
    rows: list[list[str]]
    breaks: Sequence[int] = ()


def object_tables(name: str, entry: dict[str, Any]) -> list[Table]:
    """The tables of one object: 3D if the truth is known, training views, held-out views."""
    present = {g for row in entry["rows"].values() for split in row.values() for g in split}
    return [_group_table(name, entry, group) for group in GROUP_TITLES if group in present]


def reference_row(entry: dict[str, Any]) -> str:
    """The row of an object's entry that ratios divide by."""
    return str(entry.get("reference", STATIC))


def horizon_table(name: str, entry: dict[str, Any]) -> Table | None:
    """Errors by frames ahead: in 3D where the truth is known, else of the images; None without unseen frames."""
    found = entry.get("horizon") or {}
    if not found.get("frames"):
        return None
    rows = []
    for group, metric in (("points", ERROR_3D), ("train", "psnr"), ("heldout", "psnr")):
        own = {row: means for row, groups in found["rows"].items() if (means := groups.get(group, {}).get(metric))}
        info = entry["metrics"].get(metric, {})
        where = f"{info.get('label', metric)} [{info.get('unit', '')}], {GROUP_TITLES[group]}"
        rows += [[where, row, *(_number(mean, 2) for mean in means)] for row, means in own.items()]
    head = ["figure", "row", *(f"+{frames}" for frames in found["frames"])]
    return Table(f"{name}: by frames ahead of the last seen one", head, rows)


def bounce_table(name: str, entry: dict[str, Any]) -> Table | None:
    """First bounce of every row; None for bodies that do not fall on a floor."""
    found = entry.get("bounce")
    if not found:
        return None
    rows = [[row, *(_number(told[f.key], f.digits, f.scale, f.sign) for f in BOUNCE)] for row, told in found.items()]
    title = f"{name}: centre after the first contact with the floor [scene units]"
    return Table(title, ["row", *(f.head for f in BOUNCE)], rows)


def _group_table(name: str, entry: dict[str, Any], group: str) -> Table:
    found = [m for row in entry["rows"].values() for split in row.values() for m in split.get(group, {})]
    metrics = sorted(dict.fromkeys(found), key=lambda m: m == MOTION_ENERGY)
    infos = {m: entry["metrics"].get(m) or entry["metrics"][MOTION_ENERGY] for m in metrics}
    head = ["frames", "row"]
    for metric, info in infos.items():
        head.append(f"{info['label']} [{info['unit']}]" if info["unit"] else info["label"])
        if _has_ratio(metric, info):
            head.append(f"/ {reference_row(entry)}")
    rows = []
    if group == "train" and entry["floor"]:
        rows.append(_line("0", FLOOR_ROW, entry["floor"], infos))
    for split, (start, stop) in entry["splits"].items():
        frames = f"{SPLIT_TITLES[split]} {start}..{stop - 1}"
        for row, cells in entry["rows"].items():
            if group in cells[split]:
                rows.append(_line(frames, row, cells[split][group], infos))
    return Table(f"{name}: {GROUP_TITLES[group]}", head, rows)


def _has_ratio(metric: str, info: dict[str, Any]) -> bool:
    # The track error is the 3D error in other units.
    return metric not in (MOTION_ENERGY, TRACK_ERROR) and not info["higher_is_better"]


def _line(frames: str, row: str, cells: dict[str, Any], infos: dict[str, Any]) -> list[str]:
    line = [frames, row]
    for metric, info in infos.items():
        cell = cells.get(metric, {})
        if metric == MOTION_ENERGY:
            line.append(_number(cell.get("pooled"), 2))
            continue
        mean = cell.get("mean")
        line.append("" if mean is None else plus_minus(mean, cell.get("std") or 0.0, scale=info["scale"]))
        if _has_ratio(metric, info):
            line.append(_number(cell.get("ratio"), 3))
    return line


def plus_minus(mean: float, deviation: float | None = None, *, scale: float = 1.0, digits: int = 2) -> str:
    """A figure times ``scale``, followed by its deviation if given."""
    shown = f"{mean * scale:.{digits}f}"
    return shown if deviation is None else f"{shown} {spread(deviation * scale, digits)}"


def spread(deviation: float, digits: int = 2) -> str:
    """A deviation as text."""
    return f"± {deviation:.{digits}f}"


def _number(value: float | None, digits: int, scale: float = 1.0, sign: str = "") -> str:
    return "" if value is None else f"{value * scale:.{digits}f}{sign}"


def footnotes_of(entry: dict[str, Any], method: str) -> dict[str, Any]:
    """The ``footnotes`` of a method in an object's entry; empty if there are none."""
    own = dig(entry, "footnotes", method)
    return own if isinstance(own, dict) else {}


def footnotes(entry: dict[str, Any], method: str) -> list[str]:
    """Notes on a method in an object's entry, in sentences; the first states that it does not extrapolate."""
    own = footnotes_of(entry, method)
    sentences = [NO_FORESIGHT] if own.get("extrapolates") is False else []
    notes = own.get("notes")
    return sentences + ([str(note) for note in notes] if isinstance(notes, list) else [])


def gaps(summary: dict[str, Any]) -> list[str]:
    """Metrics that no table of an evaluation has, and how to get them, in sentences."""
    absent = [found for entry in summary["objects"].values() if isinstance(found := entry.get("absent"), dict)]
    return [NO_LPIPS] if any(found.get("lpips") == NO_WEIGHTS for found in absent) else []


def markdown_table(table: Table) -> str:
    """One table as GitHub Markdown, its title as a heading."""
    texts = 1 if table.head[0] == "row" else 2
    rule = ["---"] * texts + ["---:"] * (len(table.head) - texts)
    return f"### {table.title}\n\n{markdown_rows([table.head, rule, *table.rows])}\n"


def markdown_rows(rows: Sequence[Sequence[str]]) -> str:
    """The rows of a table as GitHub Markdown, the rule below the first among them."""
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def markdown(summary: dict[str, Any]) -> str:
    """The whole ``table.md`` of an evaluation."""
    run = ", ".join(f"{key} {value}" for key, value in summary["run"].items())
    parts = ["# Evaluation", "", run, "", " ".join([LEGEND, *gaps(summary)]), ""]
    for name, entry in summary["objects"].items():
        count, frames = len(entry["sequences"]), max(entry["frames"])
        parts += [f"## {name}", "", f"{count} sequences of {frames} frames at {entry['fps']:g} fps.", ""]
        tables = [*object_tables(name, entry), bounce_table(name, entry), horizon_table(name, entry)]
        parts += [markdown_table(table) for table in tables if table is not None]
        parts += [f"* {row}: {note}\n" for row in entry["methods"] for note in footnotes(entry, row)]
    return "\n".join([*parts, _contrast(summary)])


def _contrast(summary: dict[str, Any]) -> str:
    """The paper's table of colour contrast, on which absolute errors of objects depend."""
    contrasts = {name: entry["contrast"] for name, entry in summary["objects"].items()}
    rows = [[name, *contrast_texts(c["mean_color"], c["norm"], c["max_l2"])] for name, c in contrasts.items()]
    return "## Colour contrast\n\n" + markdown_table(
        Table("foreground against black", ["object", *CONTRAST_HEAD], rows)
    )


def contrast_texts(mean_color: Sequence[float], norm: float, max_l2: float) -> tuple[str, str, str]:
    """The columns of :data:`CONTRAST_HEAD`."""
    return f"({', '.join(f'{c:.2f}' for c in mean_color)})", f"{norm:.2f}", f"{max_l2:.2f}"
