"""All tables of a report, and those of a shape of their own: ablations, efficiency, colour contrast."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gausim.report.gather import paper
from gausim.report.gather.runs import RunRecord
from gausim.report.gather.study import FULL, NOT_MEASURED, Cell, Group, Study, cell, deviation, number
from gausim.report.tables.diagnosis import diagnosis_sheets
from gausim.report.tables.sheets import (
    ABLATIONS,
    CONTRAST,
    COST,
    METHOD,
    NOTHING,
    OLD_EVALUATION,
    PAPER,
    SPLITS,
    TABLES,
    Entry,
    Line,
    Sheet,
    best_of,
    entry,
    metric_info,
    metric_sheet,
    split_title,
)
from gausim.results.curves import ERROR_3D
from gausim.results.summary import MOTION_ENERGY
from gausim.results.table import said

# What ablations are compared by: (metric, views).
_ABLATED = (
    ("l2", "train"), ("ssim", "train"), ("lpips", "train"), ("flip", "train"),
    (ERROR_3D, "points"), (MOTION_ENERGY, "points"), (MOTION_ENERGY, "train"),
)  # fmt: skip
_MEGA, _GIGA = 1e6, 1e9


def make_sheets(study: Study) -> list[Sheet]:
    """Every table that there is something for: the paper's first, then what tells more."""
    found = {pair: metric_sheet(study, *pair) for pair in TABLES}
    first = [found.pop((metric, "train")) for metric in paper.TABLES]
    sheets = [*first, *ablation_sheets(study), efficiency_sheet(study), *found.values()]
    sheets += [*diagnosis_sheets(study), contrast_sheet(study)]
    return [sheet for sheet in sheets if sheet is not None]


def ablation_sheets(study: Study) -> list[Sheet]:
    """One table per object and model that was run in several variations; columns are variations, as in the paper."""
    sheets = []
    for name in study.objects:
        families: dict[str, list[Group]] = {}
        for group in study.groups:
            if name in group.objects:
                families.setdefault(group.family, []).append(group)
        for family, groups in families.items():
            if len(groups) > 1 and study.splits(name):
                ordered = sorted(groups, key=lambda g: g.variation != FULL)
                sheets.append(_ablation(study, name, family, ordered))
    return sheets


def _ablation(study: Study, name: str, family: str, groups: Sequence[Group]) -> Sheet:
    lines: list[Line] = []
    splits = [s for s in SPLITS if s in study.splits(name)]
    for metric, views in _ABLATED:
        info = metric_info(study, metric)
        if info is None:
            continue
        for split in splits:
            cells = [cell(g, name, split, views, metric) for g in groups]
            if not any(c.value for c in cells):
                continue
            best = best_of(cells, metric, info)
            where = {"points": ", 3D" if metric == MOTION_ENERGY else "", "train": ", images"}[views]
            label = f"{info['label']}{where if metric == MOTION_ENERGY else ''}: {split_title(study, name, split)}"
            lines.append(Line(label, METHOD, tuple(entry(c, info, best=i in best) for i, c in enumerate(cells))))
            if metric == "l2" and split != "seen" and groups[0].variation == FULL:
                lines.append(_against_full(cells, split_title(study, name, split)))
    lines += _paper_ablation(name, groups, splits, study)
    caption = (
        "Rows are scaled as in the other tables. Against full: change of the mean; in brackets, in standard deviations "
        "of the difference over seeds, where both have several."
    )
    heads = ((f"{family}", tuple(g.variation for g in groups)),)
    return Sheet(
        f"ablation_{name}_{family}", ABLATIONS, f"Ablations of {family} on {name}", caption, heads, tuple(lines)
    )


def _against_full(cells: Sequence[Cell], title: str) -> Line:
    """Relative change of the error against the first column."""
    full = cells[0].value
    entries = [Entry(NOTHING, missing=True)]
    for c in cells[1:]:
        if full is None or c.value is None or not full.mean:
            entries.append(Entry(NOTHING, missing=True))
            continue
        change = c.value.mean - full.mean
        spread = None
        if full.seed_std is not None and c.value.seed_std is not None:
            spread = (full.seed_std**2 / full.seeds + c.value.seed_std**2 / c.value.seeds) ** 0.5
        extra = f"{change / spread:+.1f} σ" if spread else ""
        entries.append(Entry(f"{100 * change / full.mean:+.1f} %", extra, runs=cells[0].runs + c.runs))
    return Line(f"l2: {title}, against full", METHOD, tuple(entries))


def _paper_ablation(name: str, groups: Sequence[Group], splits: Sequence[str], study: Study) -> list[Line]:
    if paper.paper_object(name) != paper.ABLATION_OBJECT:
        return []
    lines = []
    for column, split in enumerate([splits[0], splits[-1]]):
        found = [paper.ABLATION.get(g.variation) for g in groups]
        entries = tuple(
            Entry(f"{f[column][0]:.2f} ± {f[column][1]:.2f}") if f else Entry(NOTHING, missing=True) for f in found
        )
        lines.append(Line(f"l2: {split_title(study, name, split)} (paper)", PAPER, entries))
    return lines


def efficiency_sheet(study: Study) -> Sheet:
    """Units per level, share that is predicted, seconds and memory per predicted frame and of training."""
    lines = []
    for group in study.groups:
        for name in group.objects:
            found = [(r, e.get("efficiency")) for r, e in group.entries(name)]
            costs = [
                (r, e[group.method]) for r, e in found if isinstance(e, dict) and isinstance(e.get(group.method), dict)
            ]
            label = group.label if len(study.objects) == 1 else f"{group.label}, {name}"
            fits = [_fit(entry, group.method) for _, entry in group.entries(name)]
            lines.append(Line(label, METHOD, _costs(costs, [fit for fit in fits if fit], group.of(name))))
    for method, (seconds, memory) in paper.EFFICIENCY.items():
        whole = method == "GausSim (paper)"
        levels = " → ".join(str(n) for n in paper.LEVELS) if whole else NOTHING
        texts = (
            levels, "0.05" if whole else NOTHING, f"{seconds:.2f}", NOTHING, f"{memory:.1f} GB", NOTHING, NOTHING,
            "A100",
        )  # fmt: skip
        lines.append(Line(method, PAPER, tuple(Entry(t, missing=t == NOTHING) for t in texts)))
    heads = ("units per level", "N_F / N_K", "s per frame", "ms per image", "peak memory", "trained in", "held", "on")
    caption = (
        "N_F / N_K: predicted deformation gradients over kernels. Seconds per predicted frame without drawing (mean ± "
        "standard deviation over sequences, the first warms up), milliseconds to draw one image. Memory: on a GPU the "
        "most that CUDA had allocated; on a CPU what the prediction of a sequence adds at most to the memory of the "
        "process, small: of the first sequence, which also builds the graph and loads compiled code, and the whole "
        "process, libraries and videos included. Trained in: processor time (wall time) of all sequences and objects "
        "together; held: the most memory of the training process, or of CUDA. Compare rows of one machine only. Grey: "
        "the paper's, on Mothorchids, whose seconds are those of a whole forward pass."
    )
    if any(e.text == NOT_MEASURED for line in lines for e in line.entries):
        caption += f" {OLD_EVALUATION}"
    return Sheet("efficiency", COST, "Efficiency", caption, (("", heads),), tuple(lines), "method")


def _costs(
    costs: Sequence[tuple[RunRecord, dict[str, Any]]], fits: Sequence[dict[str, Any]], runs: tuple[RunRecord, ...]
) -> tuple[Entry, ...]:
    if not costs:
        states = {r.status for r in runs if r.summary is None}
        text = next(iter(sorted(states)), NOT_MEASURED)
        return (Entry(text, missing=True, runs=runs), *(Entry(NOTHING, missing=True) for _ in range(7)))
    used = tuple(r for r, _ in costs)
    first = costs[0][1]
    levels = first.get("levels") if isinstance(first.get("levels"), dict) else {}
    counts = levels.get("counts") if isinstance(levels, dict) else None
    share = _ratio(levels)
    seconds = [x for _, c in costs if (x := _in(c, "seconds_per_frame", "mean")) is not None]
    spreads = [x for _, c in costs if (x := _in(c, "seconds_per_frame", "std")) is not None]
    drawing = [x for _, c in costs if (x := number(c.get("seconds_per_image"))) is not None]
    extra = f"± {spread:.4f}, {len(seconds)} seeds" if (spread := deviation(seconds)) is not None else ""
    mean = f"{_mean(seconds):.4f}" + (f" ± {_mean(spreads):.4f}" if spreads else "") if seconds else NOTHING
    device = f"{first.get('device', '?')}, {first.get('threads', '?')} threads"
    texts = (
        (" → ".join(str(n) for n in counts) if isinstance(counts, list) else NOTHING, ""),
        (f"{share:.3f}" if share is not None else NOTHING, ""),
        (mean, extra),
        (f"{1e3 * _mean(drawing):.2f}" if drawing else NOTHING, ""),
        _memory([c for _, c in costs]),
        _minutes(fits),
        _held(fits),
        (device, ""),
    )
    return tuple(Entry(text, small, missing=text == NOTHING, runs=used) for text, small in texts)


def _memory(costs: Sequence[dict[str, Any]]) -> tuple[str, str]:
    """What is printed large and small of the memory: of a GPU the peak, of a process what a prediction adds to it."""
    peak, added, first = (
        max((x for c in costs if (x := _in(c, "memory", f"{key}bytes")) is not None), default=None)
        for key in ("peak_", "added_", "first_added_")
    )
    if peak is None or added is None:
        return NOTHING, ""
    memory = costs[0].get("memory")
    if isinstance(memory, dict) and str(memory.get("kind", "")).startswith("CUDA"):
        return f"{peak / _GIGA:.2f} GB", f"+ {added / _MEGA:.0f} MB"
    if first is None:  # earlier versions: freed memory hid what was added
        return f"{peak / _GIGA:.2f} GB", "whole process"
    return f"+ {added / _MEGA:.1f} MB", f"first + {first / _MEGA:.0f} MB; process {peak / _GIGA:.2f} GB"


def _fit(entry: dict[str, Any], method: str) -> dict[str, Any] | None:
    """What training cost, where the run says so."""
    fit = said(entry, method).get("fit")
    return fit if isinstance(fit, dict) and number(fit.get("cpu_seconds")) else None


def _minutes(fits: Sequence[dict[str, Any]]) -> tuple[str, str]:
    """Minutes of processor time, small: of the clock, and their spread."""
    processor, wall = ([x / 60 for fit in fits if (x := number(fit.get(key)))] for key in ("cpu_seconds", "seconds"))
    if not processor:
        return NOTHING, ""
    small = [f"± {spread:.1f}, {len(processor)} seeds"] if (spread := deviation(processor)) is not None else []
    small += [f"{_mean(wall):.1f} min of wall time"] if wall else []
    return f"{_mean(processor):.1f} min", "; ".join(small)


def _held(fits: Sequence[dict[str, Any]]) -> tuple[str, str]:
    most = [x for fit in fits if (x := number(fit.get("peak_bytes")))]
    return (f"{max(most) / _GIGA:.2f} GB", "") if most else (NOTHING, "")


def _ratio(levels: Any) -> float | None:
    predictions, kernels = (
        number(levels.get(k)) if isinstance(levels, dict) else None for k in ("predictions", "kernels")
    )
    return predictions / kernels if predictions is not None and kernels else None


def _in(node: dict[str, Any], outer: str, inner: str) -> float | None:
    value = node.get(outer)
    return number(value.get(inner)) if isinstance(value, dict) else None


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def contrast_sheet(study: Study) -> Sheet:
    """The paper's table of colour contrast, which explains absolute differences between objects."""
    rows: dict[str, list[Entry]] = {"mean foreground colour": [], "its norm": [], "largest l2 of a pixel": []}
    grey: dict[str, list[Entry]] = {f"{label} (paper)": [] for label in rows}
    for name in study.objects:
        texts, runs = _contrast(study, name)
        for column, text in zip(rows.values(), texts, strict=True):
            column.append(Entry(text, missing=text == NOTHING, runs=runs))
        object_name = paper.paper_object(name)
        theirs = [NOTHING] * 3
        if object_name:
            color, norm, largest = paper.CONTRAST[object_name]
            theirs = [f"({', '.join(f'{c:.2f}' for c in color)})", f"{norm:.2f}", f"{largest:.2f}"]
        for column, text in zip(grey.values(), theirs, strict=True):
            column.append(Entry(text, missing=text == NOTHING))
    lines = [Line(label, METHOD, tuple(entries)) for label, entries in rows.items()]
    if any(not e.missing for entries in grey.values() for e in entries):
        lines += [Line(label, PAPER, tuple(entries)) for label, entries in grey.items()]
    caption = (
        "Against the black background. Bright objects get larger absolute errors from the same displacement: compare "
        "errors between objects with this in mind. The largest l2 is that of the first run in this report."
    )
    return Sheet("contrast", CONTRAST, "Colour contrast", caption, (("", tuple(study.objects)),), tuple(lines))


def _contrast(study: Study, name: str) -> tuple[list[str], tuple[RunRecord, ...]]:
    for group in study.groups:
        for run, found in group.entries(name):
            contrast = found.get("contrast")
            color = contrast.get("mean_color") if isinstance(contrast, dict) else None
            values = [number(c) for c in color] if isinstance(color, list) else []
            norm, largest = (
                number(contrast.get(k)) if isinstance(contrast, dict) else None for k in ("norm", "max_l2")
            )
            if len(values) == 3 and None not in (*values, norm, largest):
                shown = ", ".join(f"{c:.2f}" for c in values)
                return [f"({shown})", f"{norm:.2f}", f"{largest:.2f}"], (run,)
    return [NOTHING] * 3, ()
