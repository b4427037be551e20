"""Records from run directories: every figure of their evaluations, with commits, commands, hardware and cost."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain, zip_longest
from typing import Any, Literal

from gausim.report.gather.rows import FULL
from gausim.report.gather.runs import NOT_RECORDED
from gausim.report.gather.study import (
    Group,
    Study,
    Value,
    cell,
    effect,
    families,
    known,
    over_seeds,
    pooled,
    reference_rows,
    says,
)
from gausim.report.records.commands import joined
from gausim.report.records.print import SEEDS_APART
from gausim.report.records.record import SCHEMA, Cell, Column, Figure, Made, Record, RecordTable, Row, value_of
from gausim.report.tables.motion import Rows, bounces, errors_ahead, frames_ahead
from gausim.results.curves import ERROR_3D, FOLLOW_HANDS, STATIC, TRUTH
from gausim.results.summary import MOTION_ENERGY, dig
from gausim.results.table import BOUNCE, GROUP_TITLES, NO_FORESIGHT, SPLIT_TITLES, footnotes_of, reference_row

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
_BETTER: dict[bool | None, Literal["", "low", "high"]] = {True: "high", False: "low", None: ""}
# References that do not see the truth.
_BLIND = (STATIC, FOLLOW_HANDS)
# Columns of an ablation table: metric, views, frames.
_ABLATED = (
    ("l2", "train", "seen"), ("l2", "train", "unseen"), ("lpips", "train", "unseen"), ("l2", "heldout", "unseen"),
    (ERROR_3D, "points", "seen"), (ERROR_3D, "points", "unseen"), (MOTION_ENERGY, "points", "unseen"),
)  # fmt: skip


def measured_record(study: Study, title: str) -> Record:
    """The record of a study: a summary of several objects, then the tables of each."""
    runs = [run for group in study.groups for run in group.evaluated]
    machines = [str(dig(run.summary, "provenance", "machine") or NOT_RECORDED) for run in runs]
    made = Made(
        recorded=datetime.now(UTC).date().isoformat(),
        commits=list(dict.fromkeys(run.commit for run in runs)),
        commands=joined(run.command for run in runs),
        hardware=list(dict.fromkeys(machines)),
        test=study.test,
        missing=[f"{run.name} ({run.status})" for run in study.runs if run.summary is None],
    )
    objects = [_Object(study, name) for name in study.objects if study.splits(name)]
    tables = [table for item in objects for table in item.tables()]
    return Record(SCHEMA, title, made, [*_summary(study, objects), *tables])


def _summary(study: Study, objects: Sequence[_Object]) -> Iterator[RecordTable]:
    """A row per method with a few columns per object, of unseen frames; none for a single object."""
    foreseen = [item for item in objects if "unseen" in item.splits]
    if len(foreseen) < 2:
        return
    keys = [(item, *key) for item in foreseen for key in _SUMMARY if study.info(key[0]) is not None]
    columns = [item.column(metric) for item, metric, _ in keys]
    rows = []
    for group in study.groups:
        figures = [item.figure(group, group.method, "unseen", metric, views) for item, metric, views in keys]
        rows.append(Row([group.label], [value_of(figure) for figure in figures]))
    for (item, _, _), column in zip(keys, columns, strict=True):
        column.label = f"{item.name}: {column.label}"
    yield RecordTable("summary", columns, rows, title="Unseen frames", caption="Means over seeds and sequences.")


class _Object:
    """Figures and tables of one object."""

    def __init__(self, study: Study, name: str) -> None:
        self.study, self.name, self.splits = study, name, study.splits(name)
        self.groups = [group for group in study.groups if group.entries(name)]

    def tables(self) -> Iterator[RecordTable]:
        """A comparison on unseen frames with the cost, errors by frames ahead, bounces, ablations, and every metric."""
        entries = [entry for group in self.groups for _, entry in group.entries(self.name)]
        last = "unseen" if "unseen" in self.splits else "seen"
        keys = [key for key in _FIRST if self.study.info(key[0]) is not None]
        yield from self._metrics("comparison", self._frames(last), last, keys, costs=True)
        ahead = [Column(f"+{n}", 2, "low") for n in max(map(frames_ahead, entries), key=len, default=[])]
        title = "3D error [% of the diagonal] by frames after the last seen one"
        yield from self._motion("ahead", title, errors_ahead, ahead)
        first = [Column(figure.label, figure.digits, "low" if figure.sign else "") for figure in BOUNCE]
        yield from self._motion("bounce", "its centre after the first contact with the floor", bounces, first, TRUTH)
        yield from self._ablations()
        for split in self.splits:
            for views, place in GROUP_TITLES.items():
                cells = [row.get(split, {}).get(views, {}) for entry in entries for row in entry["rows"].values()]
                metrics = [metric for metric in dict.fromkeys(chain(*cells)) if self.study.info(metric)]
                metrics.sort(key=lambda metric: metric == MOTION_ENERGY)
                keys = [(metric, views) for metric in metrics]
                yield from self._metrics(f"{split}_{views}", f"{place}, {self._frames(split)}", split, keys)

    def _frames(self, split: str) -> str:
        start, stop = self.splits[split]
        return f"frames {start}..{stop - 1} ({SPLIT_TITLES.get(split, split)})"

    def _metrics(
        self, key: str, title: str, split: str, keys: Sequence[tuple[str, str]], *, costs: bool = False
    ) -> Iterator[RecordTable]:
        """A column per metric, and the costs; none without any figure."""

        def cells(group: Group, row: str) -> list[Cell]:
            figures = [self.figure(group, row, split, *key) for key in keys]
            return figures + (self._costs(group, row) if costs else [])

        rows = self._rows(cells)
        columns = [self.column(metric) for metric, _ in keys] + [*_COSTS] * costs
        kept = [i for i in range(len(columns)) if any(row.cells[i] is not None for row in rows)]
        if kept:
            shown = [Row(row.label, [row.cells[i] for i in kept], row.reference) for row in rows]
            blind = [f" {group.label}: {NO_FORESIGHT}" for group in self.groups if NO_FORESIGHT in says(group)]
            caption = SEEDS_APART + self._unlike(self.groups) + "".join(blind)
            yield self._table(key, title, caption, [columns[i] for i in kept], shown)

    def _motion(
        self, key: str, title: str, read: Callable[[dict[str, Any]], Rows], columns: list[Column], *more: str
    ) -> Iterator[RecordTable]:
        """The figures that ``read`` gives of an entry's rows; none without any."""

        def cells(group: Group, row: str) -> list[Cell]:
            found = [read(entry).get(row, ()) for entry in self._entries(group, row)]
            return [_over_seeds(values) for values in zip_longest(*found, [None] * len(columns))]

        if rows := self._rows(cells, *more):
            yield self._table(key, title, "± deviation over seeds.", columns, rows)

    def _ablations(self) -> Iterator[RecordTable]:
        """Per model with several variations: figures, and the change of l2 in unseen frames against the full model."""
        for family, groups in families(self.groups).items():
            if groups[0].variation != FULL or "unseen" not in self.splits:
                continue
            keys = [key for key in _ABLATED if self.study.info(key[0])]
            rows = []
            for group in groups:
                figures = [self.figure(group, group.method, frames, metric, views) for metric, views, frames in keys]
                rows.append(Row([group.variation], figures + self._effect(groups[0], group)))
            columns = [self.column(m, f", {'new view, ' * (v == 'heldout')}{s}") for m, v, s in keys]
            columns += [Column("l2, unseen, against full [%]", 1), Column("the same [σ]", 1)]
            caption = f"{SEEDS_APART} σ: standard error of the difference over seeds.{self._unlike(groups)}"
            yield self._table(f"ablations_{family}", family, caption, columns, rows, "variation")

    def _table(
        self, key: str, title: str, caption: str, columns: list[Column], rows: list[Row], stub: str = "method"
    ) -> RecordTable:
        return RecordTable(f"{self.name}_{key}", columns, rows, [stub], f"{self.name}, {title}", caption)

    def _rows(self, cells: Callable[[Group, str], list[Cell]], *more: str) -> list[Row]:
        """Rows with figures: of methods, then of references and ``more``, which are of the first group."""
        methods = [group.method for group in self.groups]
        others = [row for row in (*reference_rows(self.groups, [self.name]), *more) if row not in methods]
        rows = [Row([group.label], cells(group, group.method)) for group in self.groups]
        rows += [Row([row], cells(self.groups[0], row), row not in _BLIND) for row in others]
        return [row for row in rows if any(cell is not None for cell in row.cells)]

    def _entries(self, group: Group, row: str) -> list[dict[str, Any]]:
        """The entries of a row: one per seed, of references, which do not depend on seeds, the first."""
        return [entry for _, entry in group.entries(self.name)][: None if row == group.method else 1]

    def _effect(self, full: Group, group: Group) -> list[Cell]:
        """Change of l2 in unseen frames against the full model, in per cent and in standard errors over seeds."""
        a, b = (cell(g, self.name, "unseen", "train", "l2").value for g in (full, group))
        found = None if full is group else effect(a, b)
        return [None if value is None else _rounded(value) for value in found or (None, None)]

    def _unlike(self, groups: Sequence[Group]) -> str:
        """What to say where rows were not measured on the same sequences, and so cannot be compared."""
        measured = {group.label: tuple(group.entries(self.name)[0][1]["sequences"]) for group in groups}
        if len(set(measured.values())) < 2:
            return ""
        counted = "; ".join(f"{label}: {', '.join(sequences)}" for label, sequences in measured.items())
        return f" Rows of different sequences cannot be compared: {counted}."

    def column(self, metric: str, more: str = "") -> Column:
        """The column of a metric; ``more`` ends its heading."""
        if metric == MOTION_ENERGY:
            return Column(f"motion energy{more}", 2, "one")
        if metric == ERROR_3D:
            return Column(f"3D ÷ {reference_row(self.groups[0].entries(self.name)[0][1])}{more}", 3, "low")
        info = self.study.info(metric)
        assert info is not None
        unit = f" [{info['unit']}]" if info["unit"] else ""
        return Column(f"{info['label']}{unit}{more}", 2, _BETTER[info["higher_is_better"]])

    def figure(self, group: Group, row: str, split: str, metric: str, views: str) -> Cell:
        """A figure over the seeds: as a ratio to static for 3D errors, else times the metric's scale."""

        def find(entry: dict[str, Any]) -> Any:
            found = dig(entry["rows"], row, split, views, metric)
            if metric != ERROR_3D or found is None:
                return found
            mean, ratio, std = (found.get(key) for key in ("mean", "ratio", "std"))
            return {"mean": ratio, "std": std * ratio / mean if mean and ratio and std is not None else None}

        value = pooled(group, self.name, find, metric).value
        if value is None:
            return None
        entries = [entry for _, entry in group.entries(self.name)]
        infos = (entry["metrics"][metric] for entry in entries if metric in entry["metrics"])
        scale = 1.0 if metric == ERROR_3D else next(infos, {"scale": 1.0})["scale"]
        if row != group.method:
            value = replace(value, seeds=(), seed_std=None)  # references do not depend on seeds
        if all(len(entry["sequences"]) < 2 for entry in entries):
            value = replace(value, std=None)
        return _stored(value, scale)

    def _costs(self, group: Group, row: str) -> list[Cell]:
        """Costs of training and of a prediction, in the columns of ``_COSTS``, over seeds; references have none."""
        if row != group.method:
            return [None] * len(_COSTS)
        entries = self._entries(group, row)
        costs = [dig(entry, "efficiency", row) for entry in entries]
        fits = [footnotes_of(entry, row).get("fit") for entry in entries]
        added = "peak_bytes" if str(dig(costs[0], "memory", "kind")).startswith("CUDA") else "added_bytes"
        counts = dig(costs[0], "levels", "counts")
        return [
            " → ".join(map(str, counts)) if isinstance(counts, list) else None,
            _over_seeds(1 / 60 * value for value in known(fits, "cpu_seconds")),
            _over_seeds(1e-9 * value for value in known(fits, "peak_bytes")),
            _over_seeds(known(costs, "seconds_per_frame", "mean")),
            _over_seeds(1e-6 * value for value in known(costs, "memory", added)),
        ]


def _over_seeds(values: Iterable[Any]) -> Cell:
    value = over_seeds(values)
    return None if value is None else _stored(value, 1.0)


def _stored(value: Value, scale: float) -> Figure:
    """A figure as a record stores it, times ``scale``."""
    seeds = [_rounded(seed * scale) for seed in value.seeds] if len(value.seeds) > 1 else []
    spreads = [None if spread is None else _rounded(spread * scale) for spread in (value.seed_std, value.std)]
    return Figure(_rounded(value.mean * scale), seeds, *spreads)


def _rounded(value: float) -> float:
    """Six significant digits: more than any table prints."""
    return float(f"{value:.6g}")
