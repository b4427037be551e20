"""All tables of a report, and the special ones: ablations, efficiency, colour contrast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean
from typing import Any

from gausim.report.gather import paper
from gausim.report.gather.rows import FULL
from gausim.report.gather.runs import RunRecord
from gausim.report.gather.study import NOT_MEASURED, Cell, Group, Study, cell, effect, families, known, number
from gausim.report.tables.motion import bounce_sheets, diagnosis_sheets, horizon_sheets
from gausim.report.tables.sheets import (
    ABLATIONS,
    CONTRAST,
    COST,
    METHOD,
    OLD_EVALUATION,
    PAPER,
    SPLITS,
    TABLES,
    Entry,
    Line,
    Sheet,
    metric_sheet,
    plain,
    rival_entries,
    seeds_entry,
    split_title,
)
from gausim.results.curves import ERROR_3D
from gausim.results.summary import MOTION_ENERGY, dig
from gausim.results.table import CONTRAST_HEAD, contrast_texts, footnotes_of, plus_minus

# (metric, views) in which ablations are compared.
_ABLATED = (
    ("l2", "train"), ("ssim", "train"), ("lpips", "train"), ("flip", "train"),
    (ERROR_3D, "points"), (MOTION_ENERGY, "points"), (MOTION_ENERGY, "train"),
)  # fmt: skip
_MEGA, _GIGA = 1e6, 1e9


def make_sheets(study: Study) -> list[Sheet]:
    """All tables with figures: the paper's first, then further ones."""
    found = {pair: metric_sheet(study, *pair) for pair in TABLES}
    first = [found.pop((metric, "train")) for metric in paper.TABLES]
    sheets = [*first, *ablation_sheets(study), efficiency_sheet(study), *found.values()]
    sheets += [*bounce_sheets(study), *horizon_sheets(study), *diagnosis_sheets(study), contrast_sheet(study)]
    made = [sheet for sheet in sheets if sheet is not None]
    return [replace(sheet, caption=f"{sheet.caption} {study.test}") for sheet in made] if study.test else made


def ablation_sheets(study: Study) -> list[Sheet]:
    """One table per object and model with several variations; columns are variations, as in the paper."""
    sheets = []
    for name in study.objects:
        about = families([group for group in study.groups if name in group.objects] if study.splits(name) else [])
        sheets += [_ablation(study, name, family, groups) for family, groups in about.items()]
    return sheets


def _ablation(study: Study, name: str, family: str, groups: Sequence[Group]) -> Sheet:
    lines: list[Line] = []
    splits = [s for s in SPLITS if s in study.splits(name)]
    for metric, views in _ABLATED:
        info = study.info(metric)
        if info is None:
            continue
        for split in splits:
            cells = [cell(g, name, split, views, metric) for g in groups]
            if not any(c.value for c in cells):
                continue
            where = {"points": ", 3D", "train": ", images"}[views] if metric == MOTION_ENERGY else ""
            label = f"{info['label']}{where}: {split_title(study, name, split)}"
            lines.append(Line(label, METHOD, rival_entries(cells, metric, info)))
            if metric == "l2" and split != "seen" and groups[0].variation == FULL:
                lines.append(_against_full(cells, split_title(study, name, split)))
    lines += _paper_ablation(name, groups, splits, study)
    caption = (
        "Rows are scaled as in the other tables. Against full: change of the mean; in brackets, in standard deviations "
        "of the difference over seeds, where both have several."
    )
    heads = ((family, tuple(g.variation for g in groups)),)
    title = f"Ablations of {family} on {name}"
    return Sheet(f"ablation_{name}_{family}", ABLATIONS, title, caption, heads, tuple(lines))


def _against_full(cells: Sequence[Cell], title: str) -> Line:
    """Relative change of the error against the first column."""

    def against(c: Cell) -> Entry:
        change, spreads = effect(cells[0].value, c.value) or (None, None)
        if change is None:
            return plain("")
        return plain(
            f"{change:+.1f} %", f"{spreads:+.1f} σ" if spreads is not None else "", runs=cells[0].runs + c.runs
        )

    return Line(f"l2: {title}, against full", METHOD, (plain(""), *map(against, cells[1:])))


def _paper_ablation(name: str, groups: Sequence[Group], splits: Sequence[str], study: Study) -> list[Line]:
    if paper.paper_object(name) != paper.ABLATION_OBJECT:
        return []
    lines = []
    found = [paper.ABLATION.get(g.variation) for g in groups]
    for column, split in enumerate([splits[0], splits[-1]]):
        told = tuple(plain(plus_minus(*f[column]) if f else "") for f in found)
        lines.append(Line(f"l2: {split_title(study, name, split)} (paper)", PAPER, told))
    return lines


_COSTS = ("units per level", "N_F / N_K", "s per frame", "ms per image", "peak memory", "trained in", "held", "on")
_COSTS_CAPTION = (
    "N_F / N_K: predicted deformation gradients over kernels. Seconds per predicted frame without drawing (mean ± "
    "standard deviation over sequences, the first warms up), milliseconds to draw one image. Memory: on a GPU the "
    "most that CUDA had allocated; on a CPU what the prediction of a sequence adds at most to the memory of the "
    "process, small: of the first sequence, which also builds the graph and loads compiled code, and the whole "
    "process, libraries and videos included. Trained in: processor time (wall time) of all sequences and objects "
    "together; held: the most memory of the training process, or of CUDA. Compare rows of one machine only. Grey: "
    "the paper's, on Mothorchids, whose seconds are those of a whole forward pass."
)


def efficiency_sheet(study: Study) -> Sheet:
    """Units per level, their predicted fraction, time and memory per predicted frame and of training."""
    lines = []
    for group in study.groups:
        for name in group.objects:
            label = group.label if len(study.objects) == 1 else f"{group.label}, {name}"
            lines.append(Line(label, METHOD, _costs(group, name)))
    for method, (seconds, memory) in paper.EFFICIENCY.items():
        levels, fraction = (_arrows(paper.LEVELS), "0.05") if method == "GausSim (paper)" else ("", "")
        texts = (levels, fraction, f"{seconds:.2f}", "", f"{memory:.1f} GB", "", "", "A100")
        lines.append(Line(method, PAPER, tuple(map(plain, texts))))
    old = any(e.text == NOT_MEASURED for line in lines for e in line.entries)
    caption = f"{_COSTS_CAPTION} {OLD_EVALUATION}" if old else _COSTS_CAPTION
    return Sheet("efficiency", COST, "Efficiency", caption, (("", _COSTS),), tuple(lines), "method")


def _costs(group: Group, name: str) -> tuple[Entry, ...]:
    """Costs of a group's predictions and trainings on an object, in the columns of ``_COSTS``."""
    entries = group.entries(name)
    found = [(r, cost) for r, e in entries if (cost := dig(e, "efficiency", group.method))]
    if not found:
        states = sorted({r.status for r in group.of(name) if r.summary is None})
        missing = Entry(states[0] if states else NOT_MEASURED, missing=True, runs=group.of(name))
        return (missing, *map(plain, [""] * (len(_COSTS) - 1)))
    runs, costs = tuple(r for r, _ in found), [cost for _, cost in found]
    fits = [fit for _, e in entries if number(dig(fit := footnotes_of(e, group.method).get("fit"), "cpu_seconds"))]
    levels = dig(costs[0], "levels", "counts")
    predictions, kernels = (number(dig(costs[0], "levels", key)) for key in ("predictions", "kernels"))
    wall, processor = known(fits, "seconds"), known(fits, "cpu_seconds")
    note = f"{fmean(wall) / 60:.1f} min of wall time" if wall else ""
    held = max(known(fits, "peak_bytes"), default=0.0)
    return (
        plain(_arrows(levels) if isinstance(levels, list) else "", runs=runs),
        plain(f"{predictions / kernels:.3f}" if predictions is not None and kernels else "", runs=runs),
        seeds_entry(known(costs, "seconds_per_frame", "mean"), "{:.4f}",
                    stds=known(costs, "seconds_per_frame", "std"), runs=runs),
        plain(f"{1e3 * fmean(drawing):.2f}" if (drawing := known(costs, "seconds_per_image")) else "", runs=runs),
        plain(*_memory(costs), runs=runs),
        seeds_entry([seconds / 60 for seconds in processor], "{:.1f} min", note=note, runs=runs),
        plain(f"{held / _GIGA:.2f} GB" if held else "", runs=runs),
        plain(f"{costs[0].get('device', '?')}, {costs[0].get('threads', '?')} threads", runs=runs),
    )  # fmt: skip


def _arrows(counts: Sequence[Any]) -> str:
    return " → ".join(map(str, counts))


def _memory(costs: Sequence[dict[str, Any]]) -> tuple[str, str]:
    """Main and small text of the memory: of a GPU the peak, of a process the increase by a prediction."""
    peak, added, first = (
        max(known(costs, "memory", f"{key}bytes"), default=None) for key in ("peak_", "added_", "first_added_")
    )
    if peak is None or added is None:
        return "", ""
    if str(dig(costs[0], "memory", "kind")).startswith("CUDA"):
        return f"{peak / _GIGA:.2f} GB", f"+ {added / _MEGA:.0f} MB"
    if first is None:  # earlier versions: freed memory hid the increase
        return f"{peak / _GIGA:.2f} GB", "whole process"
    return f"+ {added / _MEGA:.1f} MB", f"first + {first / _MEGA:.0f} MB; process {peak / _GIGA:.2f} GB"


def contrast_sheet(study: Study) -> Sheet:
    """The paper's table of colour contrast, on which absolute errors of objects depend."""
    own = [_contrast(study, name) for name in study.objects]
    theirs = [_contrast_entries(paper.CONTRAST.get(paper.paper_object(name) or "")) for name in study.objects]
    lines = [Line(head, METHOD, row) for head, row in zip(CONTRAST_HEAD, zip(*own, strict=True), strict=True)]
    if any(not e.missing for column in theirs for e in column):
        printed = zip(CONTRAST_HEAD, zip(*theirs, strict=True), strict=True)
        lines += [Line(f"{head} (paper)", PAPER, row) for head, row in printed]
    caption = (
        "Against the black background. Bright objects get larger absolute errors from the same displacement: compare "
        "errors between objects with this in mind. The largest l2 is that of the first run in this report."
    )
    return Sheet("contrast", CONTRAST, "Colour contrast", caption, (("", tuple(study.objects)),), tuple(lines))


def _contrast(study: Study, name: str) -> tuple[Entry, ...]:
    """The contrast of an object, from the first run that recorded one."""
    for run, found in (item for group in study.groups for item in group.entries(name)):
        if contrast := found.get("contrast"):
            return _contrast_entries((contrast["mean_color"], contrast["norm"], contrast["max_l2"]), run)
    return _contrast_entries(None)


def _contrast_entries(contrast: tuple[Sequence[float], float, float] | None, *runs: RunRecord) -> tuple[Entry, ...]:
    texts = ("",) * 3 if contrast is None else contrast_texts(*contrast)
    return tuple(plain(text, runs=runs) for text in texts)
