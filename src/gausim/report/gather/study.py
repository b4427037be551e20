"""Groups runs into rows: runs that differ by their seed are one row, named after their configuration."""

from __future__ import annotations

import json
import math
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from gausim.report.gather.runs import BROKEN, EVALUATED, FAILURE, INIT_FROM, NOT_EVALUATED, UNFINISHED, RunRecord
from gausim.results.summary import MOTION_ENERGY, dig
from gausim.results.table import footnotes

FULL = "full"
NOT_MEASURED = "not measured"
# Settings that select the object of a run.
_WHICH_OBJECT = ("data.root", "data.names", "data.scene", "data.masks", "data.selections", "data.test")
# The paper's order of rows and columns; others follow.
_ORDER = ("jointly", "w/o network", "w/o mass", "w/o momentum", "w/o hierarchy")
# Largest number of differing settings in a row's name or a note.
_KEYS_IN_NAMES = 3
# States of runs without a number, in the order of precedence.
_WORST = (FAILURE, BROKEN, UNFINISHED, NOT_EVALUATED)


# The runs of a row, by their objects.
About = dict[tuple[str, ...], tuple[RunRecord, ...]]


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
    """Groups runs and names the rows."""
    by_config: dict[str, list[RunRecord]] = {}
    for run in runs:
        # A run without a configuration is a separate row.
        key = json.dumps(run.settings, sort_keys=True) if run.config else str(run.path)
        by_config.setdefault(key, []).append(run)
    members = _rows([tuple(same) for same in by_config.values()], runs)
    named = [_names(_first(about), max(map(len, about))) for about in members]
    groups = []
    for (label, family, variation), about in _joined(_distinct(named, members), members):
        evaluated = [entry for same in about.values() for run in same for entry in run.objects.values()]
        methods = list(dict.fromkeys(method for entry in evaluated for method in entry["methods"])) or [""]
        for method in methods:
            shown = f"{label}: {method}" if len(methods) > 1 else label
            groups.append(Group(shown, family, variation, method, about))
    families = list(dict.fromkeys(g.family for g in groups))
    groups.sort(key=lambda g: (families.index(g.family), _place(g.variation)))
    objects = [o for g in groups for run in g.evaluated for o in run.objects] + [o for g in groups for o in g.objects]
    names = tuple(dict.fromkeys(objects))
    return Study(tuple(runs), tuple(groups), names, tuple(_notes(groups)), _test_part(groups))


def _first(about: About) -> RunRecord:
    return next(iter(about.values()))[0]


def _rows(members: Sequence[tuple[RunRecord, ...]], runs: Sequence[RunRecord]) -> list[About]:
    """Joins runs that differ by their single object into one row; joint runs are separate rows."""
    rows: list[About] = []
    for same in members:
        names, own = _objects(same, runs), _besides_object(same[0])
        single = [row for row in rows if all(len(other) == 1 for other in (names, *row)) and same[0].config]
        row = next((row for row in single if names not in row and _besides_object(_first(row)) == own), None)
        if row is None:
            rows.append(row := {})
        row[names] = same
    return rows


def _joined(
    names: Sequence[tuple[str, str, str]], members: Sequence[About]
) -> list[tuple[tuple[str, str, str], About]]:
    """Joins equally named rows of different objects, as of a method whose settings were chosen for each object."""
    rows: list[tuple[tuple[str, str, str], About]] = []
    for name, about in zip(names, members, strict=True):
        own = {o for same in about for o in same}
        free = (row for known, row in rows if known == name and not any(own.intersection(same) for same in row))
        row = next(free, None)
        if row is None:
            rows.append((name, dict(about)))
        else:
            row.update(about)
    return rows


def _besides_object(run: RunRecord) -> dict[str, str]:
    """The settings that do not select the object: names of sequences do, their number does not.

    What a fitted method takes over was found on its object.
    """
    taken = (INIT_FROM,) if dig(run.config, "model", "method") else ()
    found = run.settings_besides((*_WHICH_OBJECT, *taken))
    return {k: v for k, v in found.items() if k != "data.sequences" or not v.startswith("[")}


def _place(variation: str) -> list[int]:
    """Sort key of a variation: none first, then the paper's order, then the order of the runs."""
    parts = variation.split(" (")[0].split(", ") if variation != FULL else []
    return [_ORDER.index(part) if part in _ORDER else len(_ORDER) for part in parts]


def _objects(same: Sequence[RunRecord], runs: Sequence[RunRecord]) -> tuple[str, ...]:
    """Objects of the runs: from their summaries, else from a run on the same data, else the data's directory."""
    names, root = _data(same[0])
    for run in (*same, *(r for r in runs if _data(r) == (names, root))):
        if run.objects:
            return tuple(run.objects)
    if isinstance(names, list) and names:
        return tuple(str(n) for n in names)
    roots = root if isinstance(root, list) else [root]
    return tuple(str(r.get("root", "?") if isinstance(r, dict) else r).rstrip("/").rsplit("/", 1)[-1] for r in roots)


def _data(run: RunRecord) -> tuple[Any, Any]:
    data = run.config.get("data")
    return (data.get("names"), data.get("root", "?")) if isinstance(data, dict) else (None, "?")


_SWITCHES = ("no_network", "no_mass", "no_momentum", "no_hierarchy")  # ablations that are identified by the settings


def _names(run: RunRecord, objects: int) -> tuple[str, str, str]:
    """(label, family, variation) from the settings of the configuration, not from its name."""
    simulator = dig(run.config, "model", "simulator")
    family = run.choices.get("model") or run.given_name
    levels = dig(simulator, "hierarchy", "levels")
    is_flat = isinstance(levels, list) and len(levels) == 1 and dig(levels[0], "diameter") == 0
    head = dig(simulator, "head")
    off = [word for word, is_off in (
        ("w/o network", dig(head, "output_scale") == 0 and dig(head, "lever") == 0),
        ("w/o mass", dig(simulator, "conserve_mass") is False),
        ("w/o momentum", dig(simulator, "conserve_momentum") is False),
        ("w/o hierarchy", is_flat),
    ) if is_off]  # fmt: skip
    name = str(dig(run.config, "ablation", "name") or "none")
    parts = [part for part in name.split("+") if part not in ("none", "full", "joint")]
    if off:  # ablations by settings are named already, others of a list are not
        parts = [part for part in parts if part not in _SWITCHES] if "+" in name else []
    varied = [*(["jointly"] if objects > 1 else []), *off, *parts]
    variation = ", ".join(varied) or FULL
    return (f"{family} {variation}" if varied else family), family, variation


def _distinct(labels: list[tuple[str, str, str]], members: Sequence[About]) -> list[tuple[str, str, str]]:
    """Distinguishes equal labels of two configurations on one object by the run's name or by settings.

    Of several full configurations, the reference of the ablations keeps the plain label.
    """
    objects = [{name: same[0] for names, same in about.items() for name in names} for about in members]
    taken = Counter((label, o) for (label, _, _), own in zip(labels, objects, strict=True) for o in own)
    plain = {_reference(family, labels, [_first(about) for about in members]) for _, family, _ in labels}
    result = []
    for i, (label, family, variation) in enumerate(labels):
        if i in plain or all(taken[label, o] < 2 for o in objects[i]):
            result.append((label, family, variation))
            continue
        rivals = [other for j, other in enumerate(objects) if labels[j][0] == label and j != i]
        tag = _difference([(run, other[o]) for o, run in objects[i].items() for other in rivals if o in other])
        result.append((f"{label} ({tag})", family, tag if variation == FULL else f"{variation} ({tag})"))
    return result


def _reference(family: str, labels: Sequence[tuple[str, str, str]], firsts: Sequence[RunRecord]) -> int | None:
    """The full configuration that differs least from the family's ablations; None without one, or in a tie."""
    full = [i for i, label in enumerate(labels) if label[1:] == (family, FULL)]
    ablated = [firsts[i].settings for i, label in enumerate(labels) if label[1] == family and i not in full]
    if not ablated:
        return None
    distances = []
    for i in full:
        own = firsts[i].settings
        distances.append(sum(own.get(k) != other.get(k) for other in ablated for k in {*own, *other}))
    nearest = [i for i, d in zip(full, distances, strict=True) if d == min(distances)]
    return nearest[0] if len(nearest) == 1 else None


def _difference(pairs: Sequence[tuple[RunRecord, RunRecord]]) -> str:
    """What distinguishes the first of two runs on one object, in all pairs: its name, or its own settings."""
    first = pairs[0][0]
    if all(rival.given_name != run.given_name for run, rival in pairs):
        return first.given_name
    own = {key: run.settings[key] for run, rival in pairs for key in _differing(run.settings, rival.settings)}
    return _first_few([f"{key.rsplit('.', 1)[-1]}={own[key]}" for key in sorted(own)]) or first.name


def _differing(own: dict[str, str], other: dict[str, str]) -> list[str]:
    return [key for key in own if other.get(key) != own[key] and not key.endswith(("name", "root"))]


def _first_few(items: Sequence[str]) -> str:
    more = [f"{len(items) - _KEYS_IN_NAMES} more"] if len(items) > _KEYS_IN_NAMES else []
    return ", ".join([*items[:_KEYS_IN_NAMES], *more])


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
        own, *others = (_besides_object(same[0]) for same in group.about.values())
        if differing := sorted({key for other in others for key in _differing(own, other)}):
            notes.append(f"{group.label}: its settings are not the same on all objects ({_first_few(differing)}).")
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
