"""Records from run directories: every figure of their evaluations, with commits, commands, hardware and cost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from statistics import fmean
from typing import Any

from gausim.report.gather.runs import RunRecord, dig
from gausim.report.gather.study import FULL, Group, Study, cell, deviation, effect, families, number, pooled, says
from gausim.report.records.commands import joined
from gausim.report.records.print import SEEDS_APART
from gausim.report.records.record import SCHEMA, Cell, Column, Figure, Made, Record, RecordTable, Row, value_of
from gausim.results.curves import ERROR_3D, FOLLOW_HANDS, STATIC, TRUTH
from gausim.results.summary import MOTION_ENERGY
from gausim.results.table import GROUP_TITLES, NO_FORESIGHT, SPLIT_TITLES, footnotes_of, reference_row

# Columns of an object's first table, of unseen frames: metric, views.
_FIRST = (
    ("l2", "train"), ("ssim", "train"), ("lpips", "train"), ("iou", "train"),
    ("chamfer", "points"), (ERROR_3D, "points"), (MOTION_ENERGY, "points"),
)  # fmt: skip
# The same of every object in the summary of several objects.
_SUMMARY = (("l2", "train"), (ERROR_3D, "points"))

# Costs beside them. Memory: the most that the training process held; what a prediction adds, on a GPU the peak.
_COSTS = (
    Column("units", 0),
    Column("fit [CPU min]", 1),
    Column("fit, memory [GB]", 1),
    Column("per frame [s]", 4),
    Column("prediction, memory [MB]", 1),
)
# The first bounce of a body on a floor, see :mod:`gausim.results.summary`: scale and column.
_BOUNCE = {
    "height": (1.0, Column("highest point after the impact [scene units]", 3)),
    "height_error": (100.0, Column("its error [%]", 1, "low")),
    "rise": (1.0, Column("rise [scene units]", 3)),
    "rise_error": (100.0, Column("its error [%]", 1, "low")),
    "depth": (1.0, Column("deepest below the floor [% of the diagonal]", 2)),
}
# Columns of an ablation table: metric, views, frames.
_ABLATED = (
    ("l2", "train", "seen"), ("l2", "train", "unseen"), ("lpips", "train", "unseen"), ("l2", "heldout", "unseen"),
    (ERROR_3D, "points", "seen"), (ERROR_3D, "points", "unseen"), (MOTION_ENERGY, "points", "unseen"),
)  # fmt: skip


def measured_record(study: Study, title: str) -> Record:
    """The record of a study.

    It has a summary of several objects, then per object a comparison on unseen frames with the cost, the 3D error by
    frames ahead, the first bounce on a floor, and every metric.
    """
    runs = [run for group in study.groups for run in group.evaluated]
    made = Made(
        recorded=datetime.now(UTC).date().isoformat(),
        commits=_distinct(run.commit for run in runs),
        commands=joined(run.command for run in runs),
        hardware=_distinct(machine(run) for run in runs),
        test=study.test,
        missing=[f"{run.name} ({run.status})" for run in study.runs if run.summary is None],
    )
    tables = [table for name in study.objects for table in _tables(study, name)]
    return Record(SCHEMA, title, made, [*_summary(study), *tables])


def machine(run: RunRecord) -> str:
    """The machine that evaluated a run, from its summary."""
    name = dig(run.summary, "provenance", "machine")
    return name if isinstance(name, str) else "not recorded"


def _summary(study: Study) -> Iterator[RecordTable]:
    """A row per method with a few columns per object, of unseen frames; none for a single object."""
    names = [name for name in study.objects if "unseen" in study.splits(name)]
    if len(names) < 2:
        return
    keys = [(name, *key) for name in names for key in _SUMMARY if study.info(key[0]) is not None]
    rows = [
        Row([g.label], [value_of(_figure(g, n, "unseen", m, v, row=None)) for n, m, v in keys]) for g in study.groups
    ]
    columns = [_column(study, n, m) for n, m, _ in keys]
    for (name, _, _), column in zip(keys, columns, strict=True):
        column.label = f"{name}: {column.label}"
    yield RecordTable("summary", columns, rows, title="Unseen frames", caption="Means over seeds and sequences.")


def _ahead(study: Study, name: str) -> Iterator[RecordTable]:
    """3D errors by frames ahead, where the true motion is known beyond the seen frames."""
    entries = [entry for group in study.groups for _, entry in group.entries(name)]
    frames = list(dict.fromkeys(n for entry in entries for n in dig(entry, "horizon", "frames") or ()))
    if rows := _rows(study, name, _ahead_of, {n: 1.0 for n in frames}):
        columns = [Column(f"+{n}", 2, "low") for n in frames]
        title = f"{name}, 3D error [% of the diagonal] by frames after the last seen one"
        yield RecordTable(f"{name}_ahead", columns, rows, title=title, caption="± deviation over seeds.")


def _bounces(study: Study, name: str) -> Iterator[RecordTable]:
    """The first bounce of a body that falls on a floor, the truth last."""

    def read(entry: dict[str, Any], row: str) -> dict[str, Any]:
        return dig(entry, "bounce", row) or {}

    if rows := _rows(study, name, read, {key: scale for key, (scale, _) in _BOUNCE.items()}, TRUTH):
        columns = [column for _, column in _BOUNCE.values()]
        title = f"{name}, its centre after the first contact with the floor"
        yield RecordTable(f"{name}_bounce", columns, rows, title=title, caption="± deviation over seeds.")


def _rows(study: Study, name: str, read: Any, scales: dict[Any, float], *more: str) -> list[Row]:
    """Rows of methods over their seeds, of references and ``more``; ``read(entry, row)`` has figures by key."""
    groups = [group for group in study.groups if group.entries(name)]
    others = (*_references(groups, name), *more) if groups else ()
    rows = []
    for group, row in [*((g, g.method) for g in groups), *((groups[0], row) for row in others)]:
        found = [read(entry, row) for _, entry in group.entries(name)][: None if row == group.method else 1]
        cells = [_over_seeds([own.get(key) for own in found], scale) for key, scale in scales.items()]
        label = group.label if row == group.method else row
        rows.append(Row([label], cells, reference=row != group.method and row not in (STATIC, FOLLOW_HANDS)))
    return [row for row in rows if any(cell is not None for cell in row.cells)]


def _ahead_of(entry: dict[str, Any], row: str) -> dict[int, Any]:
    """3D errors of a row by frames ahead."""
    errors = dig(entry, "horizon", "rows", row, "points", ERROR_3D) or []
    return dict(zip(dig(entry, "horizon", "frames") or (), errors, strict=False))


def _tables(study: Study, name: str) -> Iterator[RecordTable]:
    splits = study.splits(name)
    last = "unseen" if "unseen" in splits else "seen"
    keys = [(metric, views) for metric, views in _FIRST if study.info(metric) is not None]
    first = _table(study, name, last, keys, costs=True)
    if first is not None:
        first.key, first.title = f"{name}_comparison", f"{name}, {_frames(last, splits)}"
        yield first
    yield from _ahead(study, name)
    yield from _bounces(study, name)
    yield from _ablations(study, name)
    for split in splits:
        for views, place in GROUP_TITLES.items():
            keys = [(metric, views) for metric in _metrics(study, name, split, views)]
            found = _table(study, name, split, keys, costs=False)
            if found is not None:
                found.key, found.title = f"{name}_{split}_{views}", f"{name}, {place}, {_frames(split, splits)}"
                yield found


def _ablations(study: Study, name: str) -> Iterator[RecordTable]:
    """Per model with several variations: figures, and the change of l2 in unseen frames against the full model."""
    for family, groups in families([group for group in study.groups if group.entries(name)]).items():
        if groups[0].variation != FULL or "unseen" not in study.splits(name):
            continue
        keys = [key for key in _ABLATED if study.info(key[0])]
        rows = [Row([g.variation], [_figure(g, name, s, m, v, row=None) for m, v, s in keys]) for g in groups]
        columns = [_column(study, name, m, f", {'new view, ' * (v == 'heldout')}{s}") for m, v, s in keys]
        for group, row in zip(groups, rows, strict=True):
            row.cells += _effect(groups[0], group, name)
        columns += [Column("l2, unseen, against full [%]", 1), Column("the same [σ]", 1)]
        caption = f"{SEEDS_APART} σ: standard error of the difference over seeds.{_unlike(groups, name)}"
        yield RecordTable(f"{name}_ablations_{family}", columns, rows, ["variation"], f"{name}, {family}", caption)


def _effect(full: Group, group: Group, name: str) -> list[Cell]:
    """Change of l2 in unseen frames against the full model, in per cent and in standard errors over seeds."""
    a, b = (cell(g, name, "unseen", "train", "l2").value for g in (full, group))
    found = None if full is group else effect(a, b)
    return [None if value is None else _rounded(value) for value in found or (None, None)]


def _frames(split: str, splits: dict[str, Sequence[int]]) -> str:
    start, stop = splits[split]
    return f"frames {start}..{stop - 1} ({SPLIT_TITLES.get(split, split)})"


def _metrics(study: Study, name: str, split: str, views: str) -> list[str]:
    """Metrics that any evaluation of the object has there, the energy last."""
    entries = (entry for group in study.groups for _, entry in group.entries(name))
    found = dict.fromkeys(m for e in entries for row in e["rows"].values() for m in row.get(split, {}).get(views, {}))
    return sorted((metric for metric in found if study.info(metric)), key=lambda metric: metric == MOTION_ENERGY)


def _table(study: Study, name: str, split: str, keys: Sequence[tuple[str, str]], *, costs: bool) -> RecordTable | None:
    """Rows of methods, then of references, with a column per metric; None without any figure."""
    groups = [group for group in study.groups if group.entries(name)]
    rows = [Row([g.label], [_figure(g, name, split, *key, row=None) for key in keys]) for g in groups]
    for label in _references(groups, name):
        cells = [_figure(groups[0], name, split, *key, row=label) for key in keys]
        rows.append(Row([label], cells, reference=label not in (STATIC, FOLLOW_HANDS)))  # others see the truth
    columns = [_column(study, name, metric) for metric, _ in keys]
    if costs:
        columns += _COSTS
        own = [_costs(group, name) for group in groups]
        for i, row in enumerate(rows):
            row.cells += own[i] if i < len(own) else [None] * len(_COSTS)
    kept = [i for i in range(len(columns)) if any(row.cells[i] is not None for row in rows)]
    if not kept:
        return None
    shown = [Row(row.label, [row.cells[i] for i in kept], row.reference) for row in rows]
    shown = [row for row in shown if any(cell is not None for cell in row.cells)]
    blind = [f" {group.label}: {NO_FORESIGHT}" for group in groups if NO_FORESIGHT in says(group)]
    caption = SEEDS_APART + _unlike(groups, name) + "".join(blind)
    return RecordTable("", [columns[i] for i in kept], shown, caption=caption)


def _unlike(groups: Sequence[Group], name: str) -> str:
    """What to say where rows were not measured on the same sequences, and so cannot be compared."""
    measured = {group.label: tuple(group.entries(name)[0][1]["sequences"]) for group in groups}
    if len(set(measured.values())) < 2:
        return ""
    counted = "; ".join(f"{label}: {', '.join(sequences)}" for label, sequences in measured.items())
    return f" Rows of different sequences cannot be compared: {counted}."


def _references(groups: Sequence[Group], name: str) -> list[str]:
    entries = [entry for group in groups for _, entry in group.entries(name)]
    methods = {method for entry in entries for method in entry["methods"]}
    return list(dict.fromkeys(row for entry in entries for row in entry["rows"] if row not in methods))


def _column(study: Study, name: str, metric: str, more: str = "") -> Column:
    info = study.info(metric) or {}
    if metric == MOTION_ENERGY:
        return Column(f"motion energy{more}", 2, "one")
    if metric == ERROR_3D:
        entries = (entry for group in study.groups for _, entry in group.entries(name))
        return Column(f"3D ÷ {reference_row(next(entries))}{more}", 3, "low")
    better = {True: "high", False: "low"}.get(info.get("higher_is_better"), "")  # type: ignore[arg-type]
    unit = f" [{info['unit']}]" if info.get("unit") else ""
    return Column(f"{info['label']}{unit}{more}", 2, better)  # type: ignore[arg-type]


def _figure(group: Group, name: str, split: str, metric: str, views: str, *, row: str | None) -> Cell:
    """A figure over the seeds: as a ratio to static for 3D errors, else times the metric's scale."""

    def find(entry: dict[str, Any]) -> Any:
        found = dig(entry["rows"], row or group.method, split, views, metric)
        if metric != ERROR_3D or found is None:
            return found
        mean, ratio, std = (found.get(key) for key in ("mean", "ratio", "std"))
        return {"mean": ratio, "std": std * ratio / mean if mean and ratio and std is not None else None}

    several = any(len(entry["sequences"]) > 1 for _, entry in group.entries(name))

    value = pooled(group, name, find, metric).value
    if value is None:
        return None
    key = "pooled" if metric == MOTION_ENERGY else "mean"
    own = [dig(find(entry), key) for _, entry in group.entries(name)]
    infos = (entry["metrics"][metric] for _, entry in group.entries(name) if metric in entry["metrics"])
    scale = 1.0 if metric == ERROR_3D else next(infos, {"scale": 1.0})["scale"]
    seeds = [_rounded(v * scale) for v in own if v is not None]
    if row is not None:
        seeds = seeds[:1]  # references do not depend on seeds
    return Figure(
        _rounded(value.mean * scale),
        seeds if len(seeds) > 1 else [],
        _rounded(value.seed_std * scale) if value.seed_std is not None and row is None else None,
        _rounded(value.std * scale) if value.std is not None and several else None,
    )


def _costs(group: Group, name: str) -> list[Cell]:
    """Costs of training and of a prediction, in the columns of ``_COSTS``, over seeds."""
    entries = [entry for _, entry in group.entries(name)]
    costs = [dig(entry, "efficiency", group.method) for entry in entries]
    fits = [footnotes_of(entry, group.method).get("fit") for entry in entries]
    added = "peak_bytes" if str(dig(costs[0], "memory", "kind")).startswith("CUDA") else "added_bytes"
    counts = dig(costs[0], "levels", "counts")
    return [
        " → ".join(map(str, counts)) if isinstance(counts, list) else None,
        _over_seeds(fits, 1 / 60, "cpu_seconds"),
        _over_seeds(fits, 1e-9, "peak_bytes"),
        _over_seeds(costs, 1.0, "seconds_per_frame", "mean"),
        _over_seeds(costs, 1e-6, "memory", added),
    ]


def _over_seeds(nodes: Sequence[Any], scale: float, *keys: str) -> Cell:
    """A number of every seed, times ``scale``."""
    values = [scale * value for node in nodes if (value := number(dig(node, *keys))) is not None]
    if not values:
        return None
    spread = deviation(values)
    seeds = [_rounded(v) for v in values] if len(values) > 1 else []
    return Figure(_rounded(fmean(values)), seeds, None if spread is None else _rounded(spread))


def _rounded(value: float) -> float:
    """Six significant digits: more than any table prints."""
    return float(f"{value:.6g}")


def _distinct(texts: Iterator[str]) -> list[str]:
    return list(dict.fromkeys(texts))
