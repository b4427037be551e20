"""First screens of a report: per run a film and a sentence."""

import shlex
from dataclasses import dataclass
from itertools import zip_longest

from gausim.report.media import film_uri
from gausim.report.runs import BROKEN, FAILURE, NOT_EVALUATED, UNFINISHED, RunRecord
from gausim.report.study import Group, Study
from gausim.report.verdict import merit, sentence
from gausim.results.pivot import Pivot

# Largest number of first screens, because films make up most of a page's size.
MOST_OPENINGS = 6


@dataclass(frozen=True, eq=False)
class Opening:
    """The first screen of one run and object."""

    label: str  # its label in the list of first screens
    name: str  # of the object
    title: str  # heading: the object and the row
    run: RunRecord  # of the film
    sentence: str  # over all seeds of the row
    film: str  # data URI of the MP4; empty without one
    caption: str  # of the film, or why there is none


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
        entries = [(run, info) for run, info in group.entries(name) if run.results is not None]
        seeds = [(merit(Pivot(run.results), name, group.method, info), run) for run, info in entries if run.results]
        for place, (error, run) in enumerate(sorted(seeds, key=lambda seed: seed[0])):
            found.append(((place, error), (name, group, run)))
    return [shown for _, shown in sorted(found, key=lambda item: item[0])]


def _opening(study: Study, name: str, group: Group, run: RunRecord, *, pictures: bool) -> Opening:
    entries = group.entries(name)
    seed = f"seed {run.seed}" if len(entries) > 1 else ""
    parts = (name if len(study.objects) > 1 else "", group.label if len(study.groups) > 1 else "", seed)
    film, caption = "", "Films were left out (--no-pictures)."
    if pictures:
        film, caption = film_uri(run, name), f"{seed}: {run.objects[name].film}" if seed else run.objects[name].film
        remedy = f"The evaluation has no film. Make it with `gausim evaluate {shlex.quote(str(run.path))}`."
        caption = caption if film else remedy
    return Opening(
        label=" · ".join(filter(None, parts)) or name, name=name, title=f"{name}, predicted by {group.label}", run=run,
        sentence=sentence(study.pivot, name, group.label, entries[0][1], group.method), film=film, caption=caption,
    )  # fmt: skip


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
