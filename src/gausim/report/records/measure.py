"""Records from run directories: every figure of their evaluations, with commits, commands, hardware and cost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from statistics import fmean
from typing import Any

from gausim.report.gather.runs import RunRecord, dig
from gausim.report.gather.study import Group, Study, deviation, number, pooled
from gausim.report.records.print import SEEDS_APART
from gausim.report.records.record import SCHEMA, Cell, Column, Figure, Made, Record, RecordTable, Row
from gausim.results.curves import ERROR_3D, STATIC
from gausim.results.summary import MOTION_ENERGY
from gausim.results.table import GROUP_TITLES, SPLIT_TITLES, footnotes_of

# Columns of an object's first table, of unseen frames: metric, views.
_FIRST = (("l2", "train"), ("ssim", "train"), ("lpips", "train"), (ERROR_3D, "points"), (MOTION_ENERGY, "points"))


def measured_record(study: Study, title: str) -> Record:
    """The record of a study: per object a comparison on unseen frames with the cost, then every metric."""
    runs = [run for group in study.groups for run in group.evaluated]
    made = Made(
        recorded=datetime.now(UTC).date().isoformat(),
        commits=_distinct(run.commit for run in runs),
        commands=_distinct(run.command for run in runs),
        hardware=_distinct(machine(run) for run in runs),
        test=study.test,
    )
    tables = [table for name in study.objects for table in _tables(study, name)]
    return Record(SCHEMA, title, made, tables)


def machine(run: RunRecord) -> str:
    """The machine that evaluated a run, from its summary."""
    name = dig(run.summary, "provenance", "machine")
    return name if isinstance(name, str) else "not recorded"


def _tables(study: Study, name: str) -> Iterator[RecordTable]:
    splits = study.splits(name)
    last = "unseen" if "unseen" in splits else "seen"
    keys = [(metric, views) for metric, views in _FIRST if study.info(metric) is not None]
    first = _table(study, name, last, keys, costs=True)
    if first is not None:
        first.key, first.title = f"{name}_comparison", f"{name}, {_frames(last, splits)}"
        yield first
    for split in splits:
        for views, place in GROUP_TITLES.items():
            keys = [(metric, views) for metric in _metrics(study, name, split, views)]
            found = _table(study, name, split, keys, costs=False)
            if found is not None:
                found.key, found.title = f"{name}_{split}_{views}", f"{name}, {place}, {_frames(split, splits)}"
                yield found


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
        rows.append(Row([label], cells, reference=label != STATIC))
    columns = [_column(study, *key) for key in keys]
    if costs:
        columns += [Column("fit [CPU min]", 1), Column("per frame [s]", 4)]
        own = [_costs(group, name) for group in groups]
        for i, row in enumerate(rows):
            row.cells += own[i] if i < len(own) else [None, None]
    kept = [i for i in range(len(columns)) if any(row.cells[i] is not None for row in rows)]
    if not kept:
        return None
    shown = [Row(row.label, [row.cells[i] for i in kept], row.reference) for row in rows]
    shown = [row for row in shown if any(cell is not None for cell in row.cells)]
    return RecordTable("", [columns[i] for i in kept], shown, caption=SEEDS_APART + _unlike(groups, name))


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


def _column(study: Study, metric: str, views: str) -> Column:
    info = study.info(metric) or {}
    if metric == MOTION_ENERGY:
        return Column("motion energy", 2, "one")
    if metric == ERROR_3D:
        return Column("3D ÷ static", 3, "low")
    better = {True: "high", False: "low"}.get(info.get("higher_is_better"), "")  # type: ignore[arg-type]
    unit = f" [{info['unit']}]" if info.get("unit") else ""
    return Column(f"{info['label']}{unit}", 2, better)  # type: ignore[arg-type]


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
    scale = 1.0 if metric == ERROR_3D else next(infos)["scale"]
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
    """Minutes of processor time of training, over seeds, and seconds per predicted frame."""
    entries = [entry for _, entry in group.entries(name)]
    fits = [number(dig(footnotes_of(entry, group.method).get("fit"), "cpu_seconds")) for entry in entries]
    frames = [number(dig(entry, "efficiency", group.method, "seconds_per_frame", "mean")) for entry in entries]
    return [_over_seeds([v / 60 for v in fits if v is not None]), _over_seeds([v for v in frames if v is not None])]


def _over_seeds(values: Sequence[float]) -> Cell:
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
