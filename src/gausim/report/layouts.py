"""The tables of a report and of pages: which figures of the long table are their columns."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

from gausim.metrics.lpips import NO_LPIPS, NO_WEIGHTS
from gausim.report import paper
from gausim.report.study import EFFECT, EFFECT_SIGMA, Study, families, method_notes
from gausim.results.curves import CHAMFER, ERROR_3D, IOU, TRACK_ERROR
from gausim.results.pivot import Column, Grid, Pivot
from gausim.results.summary import AHEAD, MOTION_ENERGY, RATIO
from gausim.results.table import NO_FORESIGHT, SPLIT_TITLES, VIEW_TITLES, Cell

# Sections of tables, in the order of a page.
COMPARISON, ABLATIONS, MOTION = "Comparison", "Ablations", "3D error and motion"
TRAINING_VIEWS, NEW_VIEWS = "Images in the training views", "Images in new views"
SECTIONS = (COMPARISON, ABLATIONS, MOTION, TRAINING_VIEWS, NEW_VIEWS)
SPREAD = "± deviation over seeds; in brackets, deviation over sequences (root mean square over seeds)."
ERROR_RATIO = ERROR_3D + RATIO
# The paper's splits; `unseen_all` exists for recordings beyond frame 49.
SPLITS = ("seen", "unseen", "unseen_all")
_IMAGES = ("l2", "ssim", "lpips", "psnr", IOU)
# Metric and views of the tables whose columns are objects, the paper's three first.
_METRICS = (
    *((metric, "train") for metric in _IMAGES),
    (ERROR_3D, "points"), (TRACK_ERROR, "points"), (CHAMFER, "points"),
    (MOTION_ENERGY, "points"), (MOTION_ENERGY, "train"),
    *((metric, "heldout") for metric in _IMAGES),
)  # fmt: skip
# Columns of the layouts of one object: metric, views, and for ablations split and end of the heading.
_FIRST = (
    ("l2", "train"), ("ssim", "train"), ("lpips", "train"), (IOU, "train"),
    (CHAMFER, "points"), (ERROR_RATIO, "points"), (MOTION_ENERGY, "points"),
)  # fmt: skip
_COSTS = ("units", "fit", "fit_memory", "per_frame", "memory")
_SUMMARY = (("l2", "train"), (ERROR_RATIO, "points"))
_ABLATED = (
    ("l2", "train", "seen"), ("l2", "train", "unseen"), ("lpips", "train", "unseen"), ("l2", "heldout", "unseen"),
    (ERROR_RATIO, "points", "seen"), (ERROR_RATIO, "points", "unseen"), (MOTION_ENERGY, "points", "unseen"),
)  # fmt: skip
_BOUNCE = ("height", "height_error", "rise", "rise_error", "depth")
_ENERGY_CAPTION = (
    "Predicted over true motion energy, all sequences together: 1 is right, 0 is no motion. A prediction that "
    "dissipates gets deceptively low errors on late frames."
)
_COSTS_CAPTION = (
    "Fit: processor time of all sequences and objects together, and the most memory of the training process or of "
    "CUDA. Per frame: without drawing, the first sequence warms up. Memory of a prediction: on a GPU the most that "
    "CUDA had allocated, on a CPU what it adds to the process. Compare costs of one machine only."
)
_BOUNCE_CAPTION = "Centre of the true points after the first contact with the floor, means over sequences."


def layout(pivot: Pivot, name: str, kind: str, *, rows: Sequence[str] | None = None, **texts: str) -> Grid | None:
    """A table of one object: comparison, ahead, bounce, ablations, or all metrics of ``SPLIT VIEWS``.

    Empty ``kind``: everything known of the object, for tables made by hand. None without figures.
    """

    def places(metrics: Sequence[tuple[str, str]], split: str) -> list[Column | None]:
        return [pivot.column((name, split, views, metric)) for metric, views in metrics]

    last = "unseen" if "unseen" in pivot.results.objects[name].splits else "seen"
    if kind == "comparison":
        columns = places(_FIRST, last) + places([(metric, "") for metric in _COSTS], "")
    elif kind == "ahead":
        columns = [pivot.column((name, f"+{n}", "points", ERROR_3D), f"+{n}") for n in AHEAD]
    elif kind == "bounce":
        columns = places([(metric, "points") for metric in _BOUNCE], "bounce")
    elif kind == "ablations":
        columns = [
            pivot.column((name, split, views, metric), more=f", {'new view, ' * (views == 'heldout')}{split}")
            for metric, views, split in _ABLATED
        ]
        columns += places([(EFFECT, "train"), (EFFECT_SIGMA, "train")], "unseen")
    elif kind:
        split, _, views = kind.partition(" ")
        found = [m for m in pivot.metrics(name, split, views) if not _is_left_out(m)]
        columns = places([(metric, views) for metric in found], split)
    else:
        columns = places([(metric, "") for metric in pivot.metrics(name, "", "")], "")
    return pivot.grid(columns, rows=rows, **texts)


def _is_left_out(metric: str) -> bool:
    """Of the 3D error the ratio is shown, of others the figure itself."""
    return metric in (ERROR_3D, EFFECT, EFFECT_SIGMA) or (metric.endswith(RATIO) and metric != ERROR_RATIO)


def summary(pivot: Pivot, rows: Sequence[str] | None = None) -> Grid | None:
    """Declared trials, and a few columns per object, of unseen frames, by rows of methods; None for a single object."""
    names = [name for name, info in pivot.results.objects.items() if "unseen" in info.splits]
    methods = [row for row, kind in pivot.rows(names).items() if kind == "method"]
    chosen = methods if rows is None else [row for row in rows if row in methods]
    grid = compact(pivot, names, [f"{metric} {views} unseen" for metric, views in _SUMMARY], chosen)
    if grid is None or len(names) < 2:
        return None
    trials = declared_trials(pivot)
    if trials:
        cells = [Cell(float(trials[line.label])) if line.label in trials else None for line in grid.lines]
        lines = tuple(
            replace(line, cells=(cell, *line.cells), best=(False, *line.best))
            for line, cell in zip(grid.lines, cells, strict=True)
        )
        grid = replace(grid, columns=(Column(("", "", "", "trials"), "trials", 0), *grid.columns), lines=lines)
    return replace(grid, title="Unseen frames", caption="Means over seeds and sequences.", section=COMPARISON)


def compact(
    pivot: Pivot, names: Sequence[str], places: Sequence[str], rows: Sequence[str] | None = None, stub: str = "method"
) -> Grid | None:
    """Means without deviations and with one digit less, of several objects: columns of ``METRIC VIEWS SPLIT``."""
    columns = []
    for name in names:
        for metric, views, split in (place.split() for place in places):
            column = pivot.column((name, split, views, metric))
            if column is not None:
                label = f"{name}: {column.label}" if len(names) > 1 else column.label
                digits = None if column.digits is None else max(column.digits - 1, 1)
                columns.append(replace(column, label=label, digits=digits))
    grid = pivot.grid(columns, rows=rows, stub=stub)
    if grid is None:
        return None
    lines = [replace(line, cells=tuple(c and c._replace(seed_std=None, std=None) for c in line.cells))
             for line in grid.lines]  # fmt: skip
    return replace(grid, lines=tuple(lines))


def declared_trials(pivot: Pivot) -> dict[str, int]:
    """Trials on the development part that a record's test evaluations declare, by method."""
    made = pivot.results.made
    return {row: int(count) for row, count in re.findall(r"(\w+): (\d+) trials?\b", made.test if made else "")}


def grids(study: Study) -> list[Grid]:
    """All tables of a report, by sections."""
    made = [summary(study.pivot), *_objects(study), *(_metric(study, *key) for key in _METRICS)]
    known = [grid for grid in made if grid is not None]
    if study.test:
        known = [replace(grid, caption=f"{grid.caption} {study.test}") for grid in known]
    return sorted(known, key=lambda grid: SECTIONS.index(grid.section))


def _objects(study: Study) -> Iterator[Grid | None]:
    """The tables of each object: comparison with costs, ablations of every model, errors ahead, bounce."""
    for name, info in study.results.objects.items():
        last = "unseen" if "unseen" in info.splits else "seen"
        start, stop = info.splits[last]
        groups = [group for group in study.groups if group.entries(name)]
        blind = [f"{group.label}: {NO_FORESIGHT}" for group in groups if NO_FORESIGHT in method_notes(group)]
        caption = " ".join([SPREAD, _COSTS_CAPTION, *blind])
        title = f"{name}, frames {start}..{stop - 1} ({SPLIT_TITLES[last]})"
        yield layout(study.pivot, name, "comparison", title=title, caption=caption, section=COMPARISON)
        for family, own in families(groups).items():
            rows = [*(group.label for group in own), *(f"{key} (paper)" for key in paper.ABLATION)]
            known = [row for row in rows if row in study.pivot.rows([name])]
            caption = f"{SPREAD} σ: standard error of the difference over seeds."
            texts = {"title": f"{name}, ablations of {family}", "caption": caption, "section": ABLATIONS}
            yield layout(study.pivot, name, "ablations", rows=known, **texts)
        ahead = "3D error [% of the diagonal] by frames after the last seen one"
        for kind, title, caption in (
            ("ahead", ahead, "± deviation over seeds."),
            ("bounce", "bounce", _BOUNCE_CAPTION),
        ):
            yield layout(study.pivot, name, kind, title=f"{name}, {title}", caption=caption, section=MOTION)


def _metric(study: Study, metric: str, views: str) -> Grid | None:
    """The paper's table of a metric: rows of methods, columns of objects and splits."""
    columns = [
        study.pivot.column((name, split, views, metric), split_title(info.splits[split], split), group=name)
        for name, info in study.results.objects.items()
        for split in SPLITS
        if split in info.splits
    ]
    if not any(columns):
        return None
    info = study.results.metrics[metric]
    better = {"high": " ↑", "low": " ↓"}.get(info.better, "")
    title = f"{info.label}{f' [{info.unit}]' if info.unit else ''}{better}, {VIEW_TITLES[views]}"
    parts = [_ENERGY_CAPTION if metric == MOTION_ENERGY else SPREAD]
    if views != "points":
        parts.append("Foreground on black, as recorded; nothing brightened.")
    if any(map(paper.paper_object, study.results.objects)) and metric in paper.TABLES and views == "train":
        parts.append("Rows of the paper: its own recordings, cameras and image sizes.")
    if metric == "lpips" and any(info.absent.get(metric) == NO_WEIGHTS for info in study.results.objects.values()):
        parts.append(NO_LPIPS)
    section = MOTION if metric in (ERROR_3D, TRACK_ERROR, CHAMFER, MOTION_ENERGY) else TRAINING_VIEWS
    section = NEW_VIEWS if views == "heldout" else section
    return study.pivot.grid(columns, title=title, caption=" ".join(parts), section=section)


def split_title(span: tuple[int, int], split: str) -> str:
    """Title of a split as in the paper: Seen, or Unseen with the number of frames."""
    return "Seen" if split == "seen" else f"Unseen {span[1] - span[0]}"
