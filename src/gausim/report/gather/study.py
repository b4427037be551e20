"""Data of a report: groups of runs as rows of its tables, and figures pooled over their seeds."""

from __future__ import annotations

import json
import math
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from gausim.report.gather.rows import FULL, About, besides_object, differing, first_few, make_rows
from gausim.report.gather.runs import BROKEN, EVALUATED, FAILURE, NOT_EVALUATED, UNFINISHED, RunRecord
from gausim.results.summary import MOTION_ENERGY, dig
from gausim.results.table import footnotes

NOT_MEASURED = "not measured"
# The paper's order of rows and columns; others follow.
_ORDER = ("jointly", "w/o network", "w/o mass", "w/o momentum", "w/o hierarchy")
# States of runs without a number, in the order of precedence.
_WORST = (FAILURE, BROKEN, UNFINISHED, NOT_EVALUATED)


@dataclass(frozen=True)
class Value:
    """A figure of a row, over sequences and, if there are several, seeds."""

    mean: float  # of all seeds
    seeds: tuple[float, ...]  # of each seed, the mean over sequences
    seed_std: float | None  # sample standard deviation of the seeds (n - 1); None for one seed
    std: float | None = None  # standard deviation over sequences (over seeds: root of the mean square)


@dataclass(frozen=True)
class Cell:
    """A value, or the reason why it is missing, and its source runs."""

    value: Value | None
    status: str = ""
    runs: tuple[RunRecord, ...] = ()


@dataclass(frozen=True, eq=False)
class Group:
    """Runs of one configuration and one method of their summaries, which differ by their seeds.

    Networks of single objects with the same configuration are one group, as is one network of several objects.
    """

    label: str  # name of the row
    family: str  # the model's name, without the variation
    variation: str  # the varied settings
    method: str  # row of the summaries
    about: About  # the runs, evaluated or not

    @property
    def runs(self) -> tuple[RunRecord, ...]:
        """All of its runs."""
        return tuple(run for same in self.about.values() for run in same)

    @property
    def objects(self) -> tuple[str, ...]:
        """All of its objects."""
        return tuple(name for names in self.about for name in names)

    def of(self, name: str) -> tuple[RunRecord, ...]:
        """The runs of an object, which differ by their seeds."""
        return next((same for names, same in self.about.items() if name in names), ())

    @property
    def evaluated(self) -> list[RunRecord]:
        """The evaluated runs."""
        return [r for r in self.runs if r.summary is not None]

    def entries(self, name: str) -> list[tuple[RunRecord, dict[str, Any]]]:
        """Evaluated runs and their entries of an object."""
        return [(r, r.objects[name]) for r in self.of(name) if name in r.objects]


@dataclass(frozen=True, eq=False)
class Study:
    """Data of a report."""

    runs: tuple[RunRecord, ...]
    groups: tuple[Group, ...]  # rows of the tables
    objects: tuple[str, ...]  # columns, those with numbers first
    notes: tuple[str, ...]  # notes on the reliability of the tables
    test: str = ""  # what every table says where figures are of the test part

    def splits(self, name: str) -> dict[str, Sequence[int]]:
        """Splits of an object's frames, from its first evaluated run."""
        entries = (entry for group in self.groups for _, entry in group.entries(name))
        return dict(next(entries, {"splits": {}})["splits"])

    def info(self, metric: str) -> dict[str, Any] | None:
        """Display of a metric; None if no run has it."""
        entries = (entry for group in self.groups for run in group.evaluated for entry in run.objects.values())
        return next((entry["metrics"][metric] for entry in entries if metric in entry["metrics"]), None)


def make_study(runs: Sequence[RunRecord]) -> Study:
    """Groups runs by the rows of the tables."""
    groups = []
    for name, about in make_rows(runs):
        evaluated = [entry for same in about.values() for run in same for entry in run.objects.values()]
        methods = list(dict.fromkeys(method for entry in evaluated for method in entry["methods"])) or [""]
        for method in methods:
            shown = f"{name.label}: {method}" if len(methods) > 1 else name.label
            groups.append(Group(shown, name.family, name.variation, method, about))
    families = list(dict.fromkeys(g.family for g in groups))
    groups.sort(key=lambda g: (families.index(g.family), _place(g.variation)))
    objects = [o for g in groups for run in g.evaluated for o in run.objects] + [o for g in groups for o in g.objects]
    names = tuple(dict.fromkeys(objects))
    return Study(tuple(runs), tuple(groups), names, tuple(_notes(groups)), _test_part(groups))


def _place(variation: str) -> list[int]:
    """Sort key of a variation: none first, then the paper's order, then the order of the runs."""
    parts = variation.split(" (")[0].split(", ") if variation != FULL else []
    return [_ORDER.index(part) if part in _ORDER else len(_ORDER) for part in parts]


def says(group: Group) -> list[str]:
    """Notes on the group's method, each sentence once."""
    entries = (entry for name in group.objects for _, entry in group.entries(name))
    return list(dict.fromkeys(note for entry in entries for note in footnotes(entry, group.method)))


# Facts that all runs on an object must have in common, by their place in a summary.
_COMPARED = {
    "sequences": ("sequences",),
    "ranges of frames": ("splits",),
    "rest scenes": ("sources", "scene", "sha256"),
}


def _notes(groups: Sequence[Group]) -> list[str]:
    notes = []
    for name in dict.fromkeys(name for group in groups for name in group.objects):
        told = [(run.name, entry) for group in groups for run, entry in group.entries(name)]
        for what, keys in _COMPARED.items():
            kinds = {json.dumps(found): run for run, e in told if (found := dig(e, *keys))}
            if len(kinds) > 1:
                runs = ", ".join(kinds.values())
                notes.append(f"{name}: runs were evaluated on different {what} and cannot be compared, as {runs}.")
    for group in groups:
        own, *others = (besides_object(same[0]) for same in group.about.values())
        if varied := sorted({key for other in others for key in differing(own, other)}):
            notes.append(f"{group.label}: its settings are not the same on all objects ({first_few(varied)}).")
        notes += [f"{group.label}: {note}" for note in says(group)]
        for same in group.about.values():
            seeds = Counter(str(r.seed) for r in same if r.summary is not None)
            twice = [seed for seed, count in seeds.items() if count > 1]
            if twice:
                notes.append(f"{group.label}: seed {', '.join(twice)} is there more than once, and counts as often.")
        missing = len(group.runs) - len(group.evaluated)
        if missing and group.evaluated:
            notes.append(f"{group.label}: {missing} of {len(group.runs)} runs have no numbers.")
    return notes


def _test_part(groups: Sequence[Group]) -> str:
    """A sentence on the test part with trials and looks of every row; empty where no figure is of a test part."""
    told, others = [], []
    for group in groups:
        facts = [run.part for run in group.evaluated]
        tested = [(trials, looks) for part, trials, looks in facts if part == "test"]
        if tested:
            trials, looks = (_range([pair[i] for pair in tested]) for i in (0, 1))
            told.append(f"{group.label}: {counted(trials, 'trial')}, {counted(looks, 'look')}")
        others += [group.label] if len(tested) < len(facts) else []
    if not told:
        return ""
    more = f" Not of a test part: {', '.join(others)}." if others else ""
    return (
        "Figures of the test part, on which nothing was tuned; declared trials on the development part and looks at "
        f"the test part: {'; '.join(told)}.{more}"
    )


def counted(number: int | str, noun: str) -> str:
    """The number with its noun, in the singular or plural."""
    return f"{number} {noun}" if str(number) == "1" else f"{number} {noun}s"


def _range(values: Sequence[Any]) -> str:
    known = sorted({str(v) for v in values})
    return known[0] if len(known) == 1 else f"{known[0]} to {known[-1]}"


def cell(group: Group, name: str, split: str, views: str, metric: str, *, row: str | None = None) -> Cell:
    """A figure of a group on an object, pooled over its seeds, for its method or a reference ``row``."""
    return pooled(group, name, lambda entry: dig(entry["rows"], row or group.method, split, views, metric), metric)


def pooled(group: Group, name: str, find: Callable[[dict[str, Any]], Any], metric: str) -> Cell:
    """Pools the figure that ``find`` returns for every seed's entry of an object."""
    if name not in group.objects:
        return Cell(None)
    entries = group.entries(name)
    if not entries:
        states = {r.status for r in group.of(name)}
        worst = next((s for s in _WORST if s in states), NOT_MEASURED)
        return Cell(None, worst, group.of(name))
    # Tables show the pooled ratio of the energy, because sequences at rest distort a mean of ratios.
    key = "pooled" if metric == MOTION_ENERGY else "mean"
    found = [(run, own) for run, entry in entries if dig(own := find(entry), key) is not None]
    if not found:
        absent = [dig(entry, "absent", metric) for _, entry in entries]
        return Cell(None, next(filter(None, absent), NOT_MEASURED), tuple(run for run, _ in entries))
    stds = [std for _, own in found if (std := own.get("std")) is not None and metric != MOTION_ENERGY]
    std = math.sqrt(sum(s * s for s in stds) / len(stds)) if stds else None
    return Cell(over_seeds([own[key] for _, own in found], std), EVALUATED, tuple(run for run, _ in found))


def effect(full: Value | None, value: Value | None) -> tuple[float, float | None] | None:
    """Change of a mean against the full model's [%], and in standard errors over seeds where both have several."""
    if full is None or value is None or not full.mean:
        return None
    change, spread = value.mean - full.mean, 0.0
    if full.seed_std is not None and value.seed_std is not None:
        spread = (full.seed_std**2 / len(full.seeds) + value.seed_std**2 / len(value.seeds)) ** 0.5
    return 100 * change / full.mean, change / spread if spread else None


def reference_rows(groups: Iterable[Group], names: Iterable[str]) -> list[str]:
    """The rows of the objects' evaluations that are no methods."""
    entries = [entry for group in groups for name in names for _, entry in group.entries(name)]
    return list(dict.fromkeys(row for entry in entries for row in entry["rows"] if row not in entry["methods"]))


def families(groups: Sequence[Group]) -> dict[str, list[Group]]:
    """The rows of every model that has several variations, the full model first."""
    found = {name: [g for g in groups if g.family == name] for name in dict.fromkeys(g.family for g in groups)}
    return {name: sorted(own, key=lambda g: g.variation != FULL) for name, own in found.items() if len(own) > 1}


def over_seeds(values: Iterable[Any], std: float | None = None) -> Value | None:
    """One figure of every seed, with its deviation over sequences; None without any finite number."""
    seeds = tuple(known for value in values if (known := number(value)) is not None)
    if not seeds:
        return None
    return Value(statistics.fmean(seeds), seeds, statistics.stdev(seeds) if len(seeds) > 1 else None, std)


def known(nodes: Iterable[Any], *keys: str) -> list[float]:
    """The finite numbers that the nodes have under these keys."""
    return [value for node in nodes if (value := number(dig(node, *keys))) is not None]


def number(value: Any) -> float | None:
    """A finite number as float; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return None
    return float(value)
