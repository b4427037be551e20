"""First screens of a report: per run a video, three sentences, and one table."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any

from gausim.core import RunError
from gausim.metrics.lpips import HOW_TO_GET_WEIGHTS, NO_WEIGHTS
from gausim.report.gather.runs import BROKEN, FAILURE, NOT_EVALUATED, UNFINISHED, RunRecord
from gausim.report.gather.study import Group, Study, cell, pooled
from gausim.report.media import Film, make_film
from gausim.report.tables.sheets import NOTHING
from gausim.report.tables.verdict import NAMES, outcome, sentences
from gausim.results.curves import ERROR_3D, STATIC
from gausim.results.summary import MOTION_ENERGY, dig
from gausim.results.table import Table, plus_minus, reference_row

# Largest number of first screens, because videos make up most of a page's size.
MOST_OPENINGS = 6
# Largest number of rows of its table; the last is the reference.
MOST_ROWS = 6
# Columns: metric, views (None: those of the row), heading, digits.
_COLUMNS = (
    ("psnr", None, "PSNR [dB] ↑", 1),
    ("ssim", None, "SSIM ↑", 3),
    ("lpips", None, "LPIPS ↓", 3),
    (ERROR_3D, "points", "3D error ÷ {reference} ↓", 2),
    (MOTION_ENERGY, "points", "motion energy → 1", 2),
)


@dataclass(frozen=True, eq=False)
class Opening:
    """The first screen of one run and object."""

    label: str  # its label in the list of first screens
    name: str  # of the object
    title: str  # heading: the object and the row
    row: str  # label of its row
    seed: str  # its seed, empty if there is one only
    run: RunRecord  # of the video
    sentences: tuple[str, str, str]  # over all seeds of the row
    table: Table
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
        seeds = [(outcome([entry], group.method).merit, run) for run, entry in group.entries(name)]
        for place, (merit, run) in enumerate(sorted(seeds, key=lambda seed: seed[0])):
            found.append(((place, merit), (name, group, run)))
    return [shown for _, shown in sorted(found, key=lambda item: item[0])]


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
        if run.summary is None
    ]


def _opening(study: Study, name: str, group: Group, run: RunRecord, *, pictures: bool) -> Opening:
    entries = [entry for _, entry in group.entries(name)]
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
        sentences=sentences(outcome(entries, group.method)),
        table=first_table(study, group, name),
        film=film,
        problem=problem,
        unfinished=any(r.is_from_unfinished for r, _ in group.entries(name)),
    )


def first_table(study: Study, group: Group, name: str) -> Table:
    """The table of a first screen: frames and views of a single row, else all rows on unseen frames."""
    rivals = [g for g in study.groups if name in g.objects]
    table = _own_table(study, group, name) if len(rivals) == 1 else _comparison(study, rivals, name)
    return replace(table, title=f"{table.title} {study.test}") if study.test else table


def _own_table(study: Study, group: Group, name: str) -> Table:
    splits = study.splits(name)
    known = [split for split in ("seen", "unseen") if split in splits]
    rows = [row for split in known for row in _rows(group, name, split, f"{split} {_span(splits[split])}")]
    last, reference = "unseen" if "unseen" in known else "seen", _reference(group, name)
    rows += _rows(group, name, last, NAMES[reference], row=reference)
    seeds = "± standard deviation over seeds. " if len(group.entries(name)) > 1 else ""
    caption = (
        f"{NAMES[reference].capitalize()}: the {reference} prediction of the {last} frames. New views: never trained "
        f"on. {seeds}{_legend(rows, reference)}"
    )
    return _tidy(["frames", "views"], rows, caption, reference)


def _comparison(study: Study, rivals: list[Group], name: str) -> Table:
    splits = study.splits(name)
    split = "unseen" if "unseen" in splits else "seen"

    def merit(rival: Group) -> float:
        entries = [entry for _, entry in rival.entries(name)]
        return outcome(entries, rival.method).merit if entries else math.inf

    ordered = sorted(rivals, key=merit)
    shown = ordered[: MOST_ROWS - 1]
    views = "heldout" if any(_rows(g, name, split, "")[1:] for g in shown) else "train"
    rows = [_row(g, name, split, views, g.label) for g in shown]
    reference = _reference(shown[0], name)
    rows.append(_row(shown[0], name, split, views, NAMES[reference], row=reference))
    where = "views never trained on" if views == "heldout" else "training views"
    left = f" The best {len(shown)} of {len(ordered)} rows; all are below." if len(ordered) > len(shown) else ""
    caption = f"Frames {_span(splits[split])} ({split}), {where}. {_legend(rows, reference)}{left}"
    return _tidy(["method"], rows, caption, reference)


def _reference(group: Group, name: str) -> str:
    """The row of the reference; an unknown one counts as static."""
    found = next((reference_row(entry) for _, entry in group.entries(name)), STATIC)
    return found if found in NAMES else STATIC


def _span(split: Sequence[int]) -> str:
    return f"{split[0]}–{split[1] - 1}"


def _rows(group: Group, name: str, split: str, label: str, *, row: str | None = None) -> list[list[str]]:
    """The lines of the training views and, if measured, of the held-out views."""
    trained, new = (_row(group, name, split, views, label, row=row) for views in ("train", "heldout"))
    lines = [[label, "training", *trained[1:]]]
    return [*lines, ["", "new", *new[1:4], "", ""]] if any(map(_is_figure, new[1:4])) else lines


def _row(group: Group, name: str, split: str, views: str, label: str, *, row: str | None = None) -> list[str]:
    def ratio(entry: dict[str, Any]) -> Any:
        return {"mean": dig(entry["rows"], row or group.method, split, "points", ERROR_3D, "ratio")}

    texts = []
    for metric, own, _, digits in _COLUMNS:
        if metric == ERROR_3D:
            found = pooled(group, name, ratio, metric)
        else:
            found = cell(group, name, split, own or views, metric, row=row)
        value, text = found.value, found.status or NOTHING
        texts.append(plus_minus(value.mean, None if row else value.seed_std, digits=digits) if value else text)
    return [label, *texts]


def _is_figure(text: str) -> bool:
    return text[:1].isdigit() or text[:1] == "-"


def _legend(rows: list[list[str]], reference: str) -> str:
    text = (
        f"3D error: over that of {NAMES[reference]}, below 1 is better. Motion energy: predicted over true, 1 is right."
    )
    if any(NO_WEIGHTS in row for row in rows):
        text += f" LPIPS: its weights were not there; `{HOW_TO_GET_WEIGHTS}` gets them, then evaluate again."
    return text


def _tidy(stubs: list[str], rows: list[list[str]], caption: str, reference: str) -> Table:
    """The table without empty columns."""
    head = [*stubs, *(heading.format(reference=reference) for _, _, heading, _ in _COLUMNS)]
    kept = [i for i in range(len(head)) if i < len(stubs) or any(_is_figure(row[i]) for row in rows)]
    breaks = [i for i, row in enumerate(rows) if i and (row[0] == NAMES[reference] or (len(stubs) > 1 and row[0]))]
    return Table(caption, [head[i] for i in kept], [[row[i] for i in kept] for row in rows], breaks)
