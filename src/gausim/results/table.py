"""Tables from ``metrics.json``: Markdown text, or headers and rows for other formats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gausim.metrics.image import NO_FLIP, NO_PACKAGE
from gausim.metrics.lpips import NO_LPIPS, NO_WEIGHTS
from gausim.results.curves import ERROR_3D, STATIC, TRACK_ERROR
from gausim.results.summary import MOTION_ENERGY

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


@dataclass(frozen=True)
class Table:
    """A table of text; ``breaks`` are the rows at which a new range of frames begins."""

    title: str
    head: list[str]
    rows: list[list[str]]
    breaks: list[int]


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
    shown = [("points", ERROR_3D), ("train", "psnr"), ("heldout", "psnr")]
    rows: list[list[str]] = []
    breaks = []
    for group, metric in shown:
        own = {row: means for row, groups in found["rows"].items() if (means := groups.get(group, {}).get(metric))}
        if own:
            breaks.append(len(rows))
        info = entry["metrics"].get(metric, {})
        where = f"{info.get('label', metric)} [{info.get('unit', '')}], {GROUP_TITLES[group]}"
        rows += [[where, row, *(_number(mean, 2) for mean in means)] for row, means in own.items()]
    head = ["figure", "row", *(f"+{frames}" for frames in found["frames"])]
    return Table(f"{name}: by frames ahead of the last seen one", head, rows, breaks)


BOUNCE_HEAD = ("highest point", "its error", "rise", "its error", "deepest below the floor [% of diagonal]")


def bounce_table(name: str, entry: dict[str, Any]) -> Table | None:
    """First bounce of every row; None for bodies that do not fall on a floor."""
    found = entry.get("bounce")
    if not found:
        return None
    rows = [[row, *bounce_texts(figures)] for row, figures in found.items()]
    return Table(
        f"{name}: centre after the first contact with the floor [scene units]", ["row", *BOUNCE_HEAD], rows, []
    )


def bounce_texts(figures: dict[str, Any]) -> list[str]:
    """The columns of :data:`BOUNCE_HEAD`."""

    def percent(value: float | None) -> str:
        return "" if value is None else f"{100 * value:.1f} %"

    height, rise = _number(figures["height"], 3), _number(figures["rise"], 3)
    errors = percent(figures["height_error"]), percent(figures["rise_error"])
    return [height, errors[0], rise, errors[1], _number(figures["depth"], 2)]


def _group_table(name: str, entry: dict[str, Any], group: str) -> Table:
    metrics = _metrics_of(entry, group)
    infos = {m: entry["metrics"].get(m) or entry["metrics"][MOTION_ENERGY] for m in metrics}
    head = ["frames", "row"]
    for metric, info in infos.items():
        head.append(f"{info['label']} [{info['unit']}]" if info["unit"] else info["label"])
        if _has_ratio(metric, info):
            head.append(f"/ {reference_row(entry)}")
    rows, breaks = [], []
    if group == "train" and entry["floor"]:
        rows.append(_line("0", FLOOR_ROW, entry["floor"], infos))
    for split, (start, stop) in entry["splits"].items():
        breaks.append(len(rows))
        frames = f"{SPLIT_TITLES[split]} {start}..{stop - 1}"
        for row, cells in entry["rows"].items():
            if group in cells[split]:
                rows.append(_line(frames, row, cells[split][group], infos))
    return Table(f"{name}: {GROUP_TITLES[group]}", head, rows, breaks)


def _metrics_of(entry: dict[str, Any], group: str) -> list[str]:
    """Metrics of any row in this group, in their first order, the energy last."""
    found: dict[str, None] = {}
    for row in entry["rows"].values():
        for split in row.values():
            found.update(dict.fromkeys(split.get(group, {})))
    return sorted(found, key=lambda m: m == MOTION_ENERGY)


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


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def footnotes_of(entry: dict[str, Any], method: str) -> dict[str, Any]:
    """The ``footnotes`` of a method in an object's entry; empty if there are none."""
    every = entry.get("footnotes")
    own = every.get(method) if isinstance(every, dict) else None
    return own if isinstance(own, dict) else {}


def footnotes(entry: dict[str, Any], method: str) -> list[str]:
    """Notes on a method in an object's entry, in sentences; the first states that it does not extrapolate."""
    own = footnotes_of(entry, method)
    notes = own.get("notes")
    sentences = [str(note) for note in notes] if isinstance(notes, list) else []
    return [NO_FORESIGHT, *sentences] if own.get("extrapolates") is False else sentences


def gaps(summary: dict[str, Any]) -> list[str]:
    """Metrics that no table of an evaluation has, and how to get them, in sentences."""
    absent = [found for entry in summary["objects"].values() if isinstance(found := entry.get("absent"), dict)]
    remedies = {("flip", NO_PACKAGE): NO_FLIP, ("lpips", NO_WEIGHTS): NO_LPIPS}
    return [remedy for (key, why), remedy in remedies.items() if any(found.get(key) == why for found in absent)]


def markdown_table(table: Table) -> str:
    """One table as GitHub Markdown, its title as a heading."""
    lines = [f"### {table.title}", "", _markdown_row(table.head)]
    texts = 1 if table.head[0] == "row" else 2
    lines.append(_markdown_row(["---"] * texts + ["---:"] * (len(table.head) - texts)))
    return "\n".join(lines + [_markdown_row(row) for row in table.rows]) + "\n"


def _markdown_row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


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
    head = ["object", "mean foreground colour", "its norm", "largest l2 of a pixel"]
    rows = []
    for name, entry in summary["objects"].items():
        contrast = entry["contrast"]
        color = ", ".join(f"{c:.2f}" for c in contrast["mean_color"])
        rows.append([name, f"({color})", f"{contrast['norm']:.2f}", f"{contrast['max_l2']:.2f}"])
    return "## Colour contrast\n\n" + markdown_table(Table("foreground against black", head, rows, []))
