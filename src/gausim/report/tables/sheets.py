"""Tables of the page of a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

from gausim.metrics.lpips import NO_LPIPS, NO_WEIGHTS
from gausim.report.gather import paper
from gausim.report.gather.runs import RunRecord
from gausim.report.gather.study import NOT_MEASURED, Cell, Study, cell, over_seeds, pooled, reference_rows, says
from gausim.results.curves import CHAMFER, ERROR_3D, IOU, TRACK_ERROR
from gausim.results.summary import MOTION_ENERGY, dig
from gausim.results.table import NO_FORESIGHT, plus_minus, spread

METHOD, REFERENCE, PAPER = "method", "reference", "paper"
# The paper's splits; `unseen_all` exists for recordings beyond frame 49.
SPLITS = ("seen", "unseen", "unseen_all")
VIEWS = {"train": "training cameras", "heldout": "cameras never trained on", "points": "3D, true points"}
_IMAGES = ("l2", "ssim", "lpips", "psnr", "flip", IOU)
# (metric, views) of the tables, the paper's three first. Tables without figures of any run are left out.
TABLES = (
    *((metric, "train") for metric in _IMAGES),
    (ERROR_3D, "points"), (TRACK_ERROR, "points"), (CHAMFER, "points"),
    (MOTION_ENERGY, "points"), (MOTION_ENERGY, "train"),
    *((metric, "heldout") for metric in _IMAGES),
)  # fmt: skip
# Sections of tables, in the order of a page.
ABLATIONS, MOTION = "Ablations", "3D error and motion"
TRAINING_VIEWS, NEW_VIEWS = "Images in the training views", "Images in views never trained on"
COST, CONTRAST = "Time and memory", "Colour contrast"
SECTIONS = (ABLATIONS, MOTION, TRAINING_VIEWS, NEW_VIEWS, COST, CONTRAST)
# LPIPS, for the table of the paper's figures when no run measured it.
_LPIPS = {"label": "LPIPS", "scale": 100.0, "unit": "1e-2", "higher_is_better": False}
_UNITS = {"1e-3": "×10⁻³", "1e-2": "×10⁻²", "1e-1": "×10⁻¹", "1e-3 scene units": "10⁻³ scene units"}
NOTHING = "–"
FLOOR = "reconstruction (floor)"
OLD_EVALUATION = "Not measured: by an evaluation of an earlier version; call `gausim evaluate RUN` again."


@dataclass(frozen=True)
class Entry:
    """One entry of a table."""

    text: str  # the number, or the reason why it is missing
    extra: str = ""  # small text after it (spread over seeds)
    best: bool = False  # whether it is printed bold
    missing: bool = False  # whether the text is a reason instead of a number
    runs: tuple[RunRecord, ...] = ()  # source of the number


@dataclass(frozen=True)
class Line:
    """One row: its label, its kind (method, reference or paper), and its entries."""

    label: str
    kind: str
    entries: tuple[Entry, ...]


@dataclass(frozen=True)
class Sheet:
    """One table."""

    key: str  # short name
    section: str  # one of SECTIONS
    title: str
    caption: str  # explanation
    columns: tuple[tuple[str, tuple[str, ...]], ...]  # groups of columns: heading, headings of its columns
    lines: tuple[Line, ...]
    stub: str = ""  # heading of the labels

    @property
    def has_groups(self) -> bool:
        """Whether its columns have group headings."""
        return any(group for group, _ in self.columns)


def split_title(study: Study, name: str, split: str) -> str:
    """Title of a split as in the paper: Seen, or Unseen with the number of frames."""
    if split == "seen":
        return "Seen"
    start, stop = study.splits(name)[split]
    return f"Unseen {stop - start}"


def metric_sheet(study: Study, metric: str, views: str) -> Sheet | None:
    """The paper's table of a metric: rows of methods, columns of objects and splits; None if no run has the metric."""
    info = study.info(metric) or (_LPIPS if metric == "lpips" else None)
    if info is None:
        return None
    columns = [(name, [s for s in SPLITS if s in study.splits(name)] or ["seen"]) for name in study.objects]
    rows = [[cell(g, name, s, views, metric) for name, splits in columns for s in splits] for g in study.groups]
    if not any(c.value for row in rows for c in row) and (metric, views) != ("lpips", "train"):
        return None
    shown = zip(*(rival_entries(column, metric, info) for column in zip(*rows, strict=True)), strict=True)
    lines = [Line(group.label, METHOD, row) for group, row in zip(study.groups, shown, strict=True)]
    lines += _references(study, columns, metric, views, info)
    lines += _paper_lines(columns, metric, views)
    heads = tuple((name, tuple(split_title(study, name, s) for s in splits)) for name, splits in columns)
    title = f"{info['label']}{_unit(info)}, {VIEWS[views]}"
    blind = [f"{group.label}: {NO_FORESIGHT}" for group in study.groups if NO_FORESIGHT in says(group)]
    caption = " ".join([_caption(metric, views, info, lines), *blind])
    in_3d = metric in (ERROR_3D, TRACK_ERROR, CHAMFER, MOTION_ENERGY)
    section = MOTION if in_3d else NEW_VIEWS if views == "heldout" else TRAINING_VIEWS
    return Sheet(f"{metric}_{views}", section, title, caption, heads, tuple(lines), "method")


def _unit(info: dict[str, Any]) -> str:
    unit = _UNITS.get(info["unit"], info["unit"])
    return (f" [{unit}]" if unit else "") + {True: " ↑", False: " ↓"}.get(info["higher_is_better"], "")


def _caption(metric: str, views: str, info: dict[str, Any], lines: Sequence[Line]) -> str:
    parts = []
    if metric == MOTION_ENERGY:
        parts.append(
            "Predicted over true motion energy, all sequences together: 1 is right, 0 stands still. A prediction that "
            "dissipates gets deceptively low errors on late frames; this table tells."
        )
    else:
        parts.append("Mean ± standard deviation over sequences; small: standard deviation over seeds.")
    if views != "points":
        parts.append("Foreground on black, as recorded; nothing brightened.")
    if any(line.kind == PAPER for line in lines):
        parts.append("Grey: the paper's own figures, of its own recordings, cameras and image sizes.")
    if metric == "lpips" and any(NO_WEIGHTS in e.text for line in lines for e in line.entries):
        parts.append(NO_LPIPS)
    if any(e.text == NOT_MEASURED for line in lines for e in line.entries):
        parts.append(OLD_EVALUATION)
    return " ".join(parts)


def rival_entries(cells: Sequence[Cell], metric: str, info: dict[str, Any]) -> tuple[Entry, ...]:
    """Rival cells as printed entries, the best marked; none of a single one or without a better direction.

    Cells are compared as they are printed.
    """
    better = info["higher_is_better"]
    means = {i: round(c.value.mean * info["scale"], 2) for i, c in enumerate(cells) if c.value is not None}
    merit = {i: abs(m - 1) if metric == MOTION_ENERGY else -m if better else m for i, m in means.items()}
    is_race = len(means) > 1 and (better is not None or metric == MOTION_ENERGY)
    return tuple(_entry(c, info, best=is_race and merit.get(i) == min(merit.values())) for i, c in enumerate(cells))


def _entry(c: Cell, info: dict[str, Any], *, best: bool = False) -> Entry:
    if c.value is None:
        return Entry(c.status or NOTHING, missing=True, runs=c.runs)
    value, scale = c.value, info["scale"]
    extra = [] if value.seed_std is None else [f"{spread(value.seed_std * scale)}, {len(value.seeds)} seeds"]
    extra += ["unfinished"] if any(r.is_from_unfinished for r in c.runs) else []
    return Entry(plus_minus(value.mean, value.std, scale=scale), ", ".join(extra), best, runs=c.runs)


def seeds_entry(
    values: Sequence[float | None], form: str, *, stds: Sequence[float] = (), note: str = "",
    runs: tuple[RunRecord, ...] = (),
) -> Entry:  # fmt: skip
    """The mean of one figure per seed (and of ``stds``), followed in small by the spread of the seeds and ``note``."""
    value = over_seeds(values)
    if value is None:
        return plain("", runs=runs)
    text = " ± ".join(form.format(fmean(part)) for part in (value.seeds, stds) if part)
    small = "" if value.seed_std is None else f"± {form.format(value.seed_std)}, {len(value.seeds)} seeds"
    return plain(text, "; ".join(filter(None, (small, note))), runs=runs)


def plain(text: str, extra: str = "", *, runs: tuple[RunRecord, ...] = ()) -> Entry:
    """An entry with a text; a missing entry if the text is empty."""
    return Entry(text or NOTHING, extra, missing=not text, runs=runs)


def _references(
    study: Study, columns: Sequence[tuple[str, list[str]]], metric: str, views: str, info: dict[str, Any]
) -> list[Line]:
    """Rows of references in the summaries, and in the training views the reconstruction against frame 0.

    The reconstruction's figure, in the column of seen frames, is the floor of any prediction.
    """
    # References depend neither on the method nor on the seed: the first run that has one shows it.
    alone = {
        name: [replace(g, about={(name,): (run,)}) for g in study.groups for run, _ in g.entries(name)]
        for name, _ in columns
    }

    def first(name: str, split: str, row: str) -> Cell:
        if row == FLOOR and split != "seen":
            return Cell(None)
        keys = ("floor", metric) if row == FLOOR else ("rows", row, split, views, metric)
        cells = (pooled(one, name, lambda e: dig(e, *keys), metric) for one in alone[name])
        return next((c for c in cells if c.value), Cell(None))

    lines = []
    for row in [*reference_rows(study.groups, study.objects), *([FLOOR] if views == "train" else [])]:
        cells = [first(name, split, row) for name, splits in columns for split in splits]
        if any(c.value for c in cells):
            lines.append(Line(row, REFERENCE, tuple(_entry(c, info) for c in cells)))
    return lines


def _paper_lines(columns: Sequence[tuple[str, list[str]]], metric: str, views: str) -> list[Line]:
    table = paper.TABLES.get(metric, {}) if views == "train" else {}
    objects = [paper.paper_object(name) for name, _ in columns]
    lines = []
    for method, figures in table.items() if any(objects) else ():
        pairs = []
        for name, (_, splits) in zip(objects, columns, strict=True):
            seen, unseen = figures[name] if name else (None, None)
            late = "unseen_all" if name in paper.LATE and "unseen_all" in splits else "unseen"
            pairs += [{"seen": seen, late: unseen}.get(split) for split in splits]
        lines.append(Line(method, PAPER, tuple(plain(plus_minus(*pair) if pair else "") for pair in pairs)))
    return lines
