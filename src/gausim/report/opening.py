"""First screens of a report: per run a video, two sentences, and one table."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

from gausim.core import RunError
from gausim.metrics.lpips import HOW_TO_GET_WEIGHTS, NO_WEIGHTS
from gausim.report.layouts import ERROR_RATIO
from gausim.report.media import Film, make_film
from gausim.report.runs import BROKEN, FAILURE, NOT_EVALUATED, UNFINISHED, RunRecord
from gausim.report.study import Group, Study
from gausim.report.verdict import NAMES, Outcome, outcome, sentences
from gausim.results.pivot import Column, Grid, Pivot, joined
from gausim.results.summary import MOTION_ENERGY
from gausim.results.table import STATIC, ObjectInfo

# Largest number of first screens, because videos make up most of a page's size.
MOST_OPENINGS = 6
# Largest number of rows of its table; the last is the reference.
MOST_ROWS = 6
# Columns: metric, views, end of the heading.
_COLUMNS = (
    ("psnr", "train", ""), ("psnr", "heldout", ", new views"), ("ssim", "train", ""), ("lpips", "train", ""),
    (ERROR_RATIO, "points", ""), (MOTION_ENERGY, "points", ""),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Opening:
    """The first screen of one run and object."""

    label: str  # its label in the list of first screens
    name: str  # of the object
    title: str  # heading: the object and the row
    row: str  # label of its row
    seed: str  # its seed, empty if there is one only
    run: RunRecord  # of the video
    sentences: tuple[str, str]  # over all seeds of the row
    grid: Grid | None
    film: Film | None
    problem: str  # reason for a missing video, and the remedy
    unfinished: bool  # whether the figures are of an unfinished training


def make_openings(study: Study, *, pictures: bool = True) -> tuple[list[Opening], int]:
    """The first screens of the best runs, and the number of omitted ones beyond ``MOST_OPENINGS``.

    The best run of every object is first, then the next of each; one seed per row before further seeds.
    """
    ranked = [_ranked(study, name) for name in study.objects]
    turns = [run for turn in zip_longest(*ranked) for run in turn if run is not None]
    shown = [_opening(study, *item, pictures=pictures) for item in turns[:MOST_OPENINGS]]
    return shown, len(turns) - len(shown)


def _ranked(study: Study, name: str) -> list[tuple[str, Group, RunRecord]]:
    """The evaluated runs of an object, sorted by error, with the best seed of every row first."""
    found = []
    for group in study.groups:
        seeds = [(_merit(run, name, group.method, info), run) for run, info in group.entries(name)]
        for place, (merit, run) in enumerate(sorted(seeds, key=lambda seed: seed[0])):
            found.append(((place, merit), (name, group, run)))
    return [shown for _, shown in sorted(found, key=lambda item: item[0])]


def _merit(run: RunRecord, name: str, method: str, info: ObjectInfo) -> float:
    assert run.results is not None
    return outcome(Pivot(run.results), name, method, info).merit


def unanswered(study: Study) -> list[str]:
    """For every run without figures a sentence with the command, in backquotes, that computes them."""
    remedies = {
        NOT_EVALUATED: "{name} is trained and not evaluated: `gausim evaluate {path}` measures it.",
        UNFINISHED: "{name} is not finished ({detail}): give its `gausim train` command again, or measure what there "
        "is with `gausim evaluate {path}`.",
        FAILURE: "{name} failed ({detail}): mend the cause and give its `gausim train` command again.",
        BROKEN: "{name} has broken files: {detail}",
    }
    return [
        remedies[run.status].format(name=run.name, detail=run.detail, path=shlex.quote(str(run.path)))
        for run in study.runs
        if run.results is None
    ]


def _opening(study: Study, name: str, group: Group, run: RunRecord, *, pictures: bool) -> Opening:
    entries = group.entries(name)
    seed = f"seed {run.seed}" if len(entries) > 1 else ""
    parts = (name if len(study.objects) > 1 else "", group.label if len(study.groups) > 1 else "", seed)
    film, problem = None, "Videos were left out (--no-pictures)."
    if pictures:
        try:
            film = make_film(run, name, group.method)
        except RunError as error:
            problem = f"There is no video: {error}"
    return Opening(
        label=" · ".join(filter(None, parts)) or name,
        name=name,
        title=f"{name}, predicted by {group.label}",
        row=group.label,
        seed=seed,
        run=run,
        sentences=sentences(_outcome(study, group, name)),
        grid=first_grid(study, group, name),
        film=film,
        problem=problem,
        unfinished=any(r.is_from_unfinished for r, _ in entries),
    )


def _outcome(study: Study, group: Group, name: str) -> Outcome:
    return outcome(study.pivot, name, group.label, group.entries(name)[0][1], group.method)


def first_grid(study: Study, group: Group, name: str) -> Grid | None:
    """The table of a first screen: ranges of frames of a single row, else the best rows on unseen frames."""
    info = study.results.objects[name]
    rivals = [g for g in study.groups if g.entries(name)]
    splits = [split for split in ("seen", "unseen") if split in info.splits]
    reference = info.reference if info.reference in NAMES else STATIC
    if len(rivals) == 1:
        grids = [_part(study, name, split, {group.label: f"{split} {_span(info.splits[split])}"}) for split in splits]
        grids.append(_part(study, name, splits[-1], {reference: NAMES[reference]}))
        stub = "frames"
        caption = f"{NAMES[reference].capitalize()}: the {reference} prediction of the {splits[-1]} frames."
    else:
        ordered = sorted(rivals, key=lambda rival: _outcome(study, rival, name).merit)
        labels = {rival.label: rival.label for rival in ordered[: MOST_ROWS - 1]}
        grids, stub = [_part(study, name, splits[-1], labels | {reference: NAMES[reference]})], "method"
        left = f" The best {len(labels)} of {len(ordered)} rows; all are below." if len(ordered) > len(labels) else ""
        caption = f"Frames {_span(info.splits[splits[-1]])} ({splits[-1]}).{left}"
    found = joined(grids)
    return None if found is None else _tidy(replace(found, stub=stub), f"{caption} {_legend(info, reference)}", study)


def _part(study: Study, name: str, split: str, labels: dict[str, str]) -> Grid | None:
    """The rows of one range of frames, with other labels."""
    columns = []
    for metric, views, more in _COLUMNS:
        known = study.results.metrics.get(metric)
        if known is not None:
            found = study.pivot.column((name, split, views, metric), more=more)
            columns.append(found or Column((name, split, views, metric), "", known.digits, known.better))
    grid = study.pivot.grid(columns, rows=list(labels))
    if grid is None:
        return None
    return replace(grid, lines=tuple(replace(line, label=labels[line.label]) for line in grid.lines))


def _tidy(grid: Grid, caption: str, study: Study) -> Grid:
    """The grid without empty columns and deviations over sequences."""
    kept = [i for i in range(len(grid.columns)) if any(line.cells[i] is not None for line in grid.lines)]
    lines = [
        replace(
            line,
            cells=tuple(cell and cell._replace(std=None) for cell in (line.cells[i] for i in kept)),
            best=tuple(line.best[i] for i in kept),
        )
        for line in grid.lines
    ]
    columns = tuple(grid.columns[i] for i in kept)
    return replace(grid, columns=columns, lines=tuple(lines), caption=f"{caption} {study.test}".strip())


def _span(split: Sequence[int]) -> str:
    return f"{split[0]}–{split[1] - 1}"


def _legend(info: ObjectInfo, reference: str) -> str:
    text = (
        f"3D: error over that of {NAMES[reference]}, below 1 is better. Motion energy: predicted over true, 1 is right."
        " ± is the deviation over seeds."
    )
    if info.absent.get("lpips") == NO_WEIGHTS:
        text += f" LPIPS: its weights were not there; `{HOW_TO_GET_WEIGHTS}` gets them, then evaluate again."
    return text
