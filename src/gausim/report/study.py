"""Data of a report: groups of runs as rows of its tables, and one long table of all their figures."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import msgspec

from gausim.report import paper
from gausim.report.rows import ABLATIONS, FULL, About, besides_object, differing, first_few, make_rows
from gausim.report.runs import BROKEN, FAILURE, NOT_EVALUATED, NOT_RECORDED, UNFINISHED, RunRecord
from gausim.results.pivot import Pivot
from gausim.results.table import METHOD, PAPER, SCHEMA, Cell, Entry, Made, Metric, ObjectInfo, Results

_ORDER = list(ABLATIONS.values())
# States of runs without a number, in the order of precedence.
_WORST = (FAILURE, BROKEN, UNFINISHED, NOT_EVALUATED)
# Change of l2 in unseen frames against the full model, and the same in standard errors over seeds.
EFFECT, EFFECT_SIGMA = "l2_effect", "l2_effect_sigma"
_EFFECTS = {
    EFFECT: Metric("l2, unseen, against full", "%", digits=1),
    EFFECT_SIGMA: Metric("the same", "σ", digits=1),
}
_L2 = "unseen", "train", "l2"
# Facts that all runs on an object must have in common.
_COMPARED: dict[str, Callable[[ObjectInfo], Any]] = {
    "sequences": lambda info: info.sequences,
    "ranges of frames": lambda info: info.splits,
    "rest scenes": lambda info: info.sources.get("scene", {}).get("sha256"),
}


@dataclass(frozen=True, eq=False)
class Group:
    """Runs of one configuration and one method of their evaluations, which differ by their seeds.

    Networks of single objects with the same configuration are one group, as is one network of several objects.
    """

    label: str  # name of the row
    family: str  # the model's name, without the variation
    variation: str  # the varied settings
    method: str  # row of the evaluations
    about: About  # the runs, evaluated or not

    @property
    def runs(self) -> tuple[RunRecord, ...]:
        """All of its runs."""
        return tuple(dict.fromkeys(run for same in self.about.values() for run in same))

    @property
    def objects(self) -> tuple[str, ...]:
        """All of its objects."""
        return tuple(self.about)

    def of(self, name: str) -> list[RunRecord]:
        """The runs of an object, which differ by their seeds."""
        return self.about.get(name, [])

    @property
    def evaluated(self) -> list[RunRecord]:
        """The evaluated runs."""
        return [r for r in self.runs if r.results is not None]

    def entries(self, name: str) -> list[tuple[RunRecord, ObjectInfo]]:
        """Evaluated runs and their facts of an object."""
        return [(r, r.objects[name]) for r in self.of(name) if name in r.objects]

    def state(self, name: str) -> str:
        """Why an object has no figures: the worst state of its runs; empty where there are some."""
        states = {r.status for r in self.of(name)}
        return "" if self.entries(name) else next((s for s in _WORST if s in states), "")


@dataclass(frozen=True, eq=False)
class Study:
    """Data of a report."""

    runs: tuple[RunRecord, ...]
    groups: tuple[Group, ...]  # rows of methods
    objects: tuple[str, ...]  # those with numbers first
    results: Results  # figures of all evaluated runs and of the paper, by the labels of the groups
    notes: tuple[str, ...]  # notes on the reliability of the tables
    pivot: Pivot = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pivot", Pivot(self.results))

    @property
    def test(self) -> str:
        """What every table says where figures are of the test part."""
        return self.results.made.test if self.results.made else ""


def make_study(runs: Sequence[RunRecord], title: str = "Report") -> Study:
    """Groups runs by the rows of the tables."""
    groups = []
    for name, about in make_rows(runs):
        evaluated = [info for same in about.values() for run in same for info in run.objects.values()]
        methods = list(dict.fromkeys(method for info in evaluated for method in info.methods)) or [""]
        for method in methods:
            shown = f"{name.label}: {method}" if len(methods) > 1 else name.label
            groups.append(Group(shown, name.family, name.variation, method, about))
    models = list(dict.fromkeys(g.family for g in groups))
    groups.sort(key=lambda g: (models.index(g.family), _place(g.variation)))
    objects = [o for g in groups for run in g.evaluated for o in run.objects] + [o for g in groups for o in g.objects]
    return Study(tuple(runs), tuple(groups), tuple(dict.fromkeys(objects)), _results(runs, groups, title),
                 tuple(dict.fromkeys(_notes(groups))))  # fmt: skip


def _place(variation: str) -> list[int]:
    """Sort key of a variation: none first, then the paper's order, then the order of the runs."""
    parts = variation.split(" (")[0].split(", ") if variation != FULL else []
    return [_ORDER.index(part) if part in _ORDER else len(_ORDER) for part in parts]


def families(groups: Sequence[Group]) -> dict[str, list[Group]]:
    """The rows of every model that has several variations, the full model first."""
    found = {name: [g for g in groups if g.family == name] for name in dict.fromkeys(g.family for g in groups)}
    return {name: sorted(own, key=lambda g: g.variation != FULL) for name, own in found.items() if len(own) > 1}


def _results(runs: Sequence[RunRecord], groups: Sequence[Group], title: str) -> Results:
    """One long table of all groups: methods, references of each object's first run, the paper, effects of ablations."""
    objects: dict[str, ObjectInfo] = {}
    metrics: dict[str, Metric] = {}
    table: list[Entry] = []
    others: dict[str, list[Entry]] = {}
    methods = {group.method for group in groups}
    evaluated = [run for group in groups for run in group.evaluated]
    for group in groups:
        for run in group.evaluated:
            assert run.results is not None
            metrics |= run.results.metrics
            own = [e for e in run.results.table if e.row == group.method]
            table += [msgspec.structs.replace(e, row=group.label, seed=run.seed) for e in own]
            for name, info in run.objects.items():
                objects.setdefault(name, msgspec.structs.replace(info, sources={}))
                found = (e for e in run.results.table if e.object == name and e.row not in methods)
                others.setdefault(name, list(found))
    table += [entry for found in others.values() for entry in found]
    made = Made(
        recorded=datetime.now(UTC).date().isoformat(),
        commits=list(dict.fromkeys(run.commit for run in evaluated)),
        commands=list(dict.fromkeys(run.command for run in evaluated)),
        hardware=list(dict.fromkeys(_machine(run) for run in evaluated)),
        test=_test_part(groups),
        missing=[f"{run.name} ({run.status})" for run in runs if run.results is None],
    )
    table += [entry for entry in _paper_entries(objects) if entry.metric in metrics]
    results = Results(SCHEMA, title, made=made, objects=objects, metrics=metrics | _EFFECTS, table=table)
    return msgspec.structs.replace(results, table=[*table, *_effects(groups, Pivot(results))])


def _machine(run: RunRecord) -> str:
    return str((run.results.provenance if run.results else {}).get("machine") or NOT_RECORDED)


def _paper_entries(objects: dict[str, ObjectInfo]) -> Iterator[Entry]:
    """The paper's figures of the objects that it shows."""
    for name, info in objects.items():
        theirs = paper.paper_object(name)
        late = "unseen_all" if theirs in paper.LATE and "unseen_all" in info.splits else "unseen"
        if theirs is None:
            continue
        for metric, methods in paper.TABLES.items():
            for method, figures in methods.items():
                for split, figure in zip(("seen", late), figures[theirs], strict=True):
                    yield Entry(method, PAPER, name, split, "train", metric, None, *figure)
        for variation, pairs in paper.ABLATION.items() if theirs == paper.ABLATION_OBJECT else ():
            for split, figure in zip(("seen", late), pairs, strict=True):
                yield Entry(f"{variation} (paper)", PAPER, name, split, "train", "l2", None, *figure)
        for method, (seconds, gigabytes) in paper.EFFICIENCY.items() if theirs == paper.ABLATION_OBJECT else ():
            yield Entry(method, PAPER, name, "", "", "per_frame", None, seconds)
            yield Entry(method, PAPER, name, "", "", "memory", None, 1e3 * gigabytes)
            yield Entry(method, PAPER, name, "", "", "hardware", None, "A100, drawing included")


def _effects(groups: Sequence[Group], pivot: Pivot) -> Iterator[Entry]:
    """Change of l2 in unseen frames against each model's full variation."""
    for full, *ablated in families(groups).values():
        for group in ablated if full.variation == FULL else ():
            for name in group.objects:
                change, sigma = effect(*(pivot.cell(g.label, (name, *_L2)) for g in (full, group)))
                for metric, value in ((EFFECT, change), (EFFECT_SIGMA, sigma)):
                    if value is not None:
                        yield Entry(group.label, METHOD, name, "unseen", "train", metric, None, value)


def effect(full: Cell | None, cell: Cell | None) -> tuple[float | None, float | None]:
    """Change of a mean against the full model's [%], and in standard errors over seeds where both have several."""
    if full is None or cell is None or not full.number or cell.number is None:
        return None, None
    change, spread = cell.number - full.number, 0.0
    if full.seed_std is not None and cell.seed_std is not None:
        spread = (full.seed_std**2 / len(full.seeds) + cell.seed_std**2 / len(cell.seeds)) ** 0.5
    return 100 * change / full.number, change / spread if spread else None


def _notes(groups: Sequence[Group]) -> Iterator[str]:
    for name in dict.fromkeys(name for group in groups for name in group.objects):
        told = [(run.name, info) for group in groups for run, info in group.entries(name)]
        for what, of in _COMPARED.items():
            kinds = {json.dumps(found): run for run, info in told if (found := of(info))}
            if len(kinds) > 1:
                runs = ", ".join(kinds.values())
                yield f"{name}: runs were evaluated on different {what} and cannot be compared, as {runs}."
    for group in groups:
        own, *others = (besides_object(same[0]) for same in group.about.values())
        if varied := sorted({key for other in others for key in differing(own, other)}):
            yield f"{group.label}: its settings are not the same on all objects ({first_few(varied)})."
        yield from (f"{group.label}: {note}" for note in method_notes(group))
        for same in group.about.values():
            seeds = Counter(str(r.seed) for r in same if r.results is not None)
            twice = [seed for seed, count in seeds.items() if count > 1]
            if twice:
                yield f"{group.label}: seed {', '.join(twice)} is there more than once, and counts as often."
        if any(run.is_from_unfinished for run in group.runs):
            yield f"{group.label}: measured before its training was finished."
        missing = len(group.runs) - len(group.evaluated)
        if missing and group.evaluated:
            yield f"{group.label}: {missing} of {len(group.runs)} runs have no numbers."


def method_notes(group: Group) -> list[str]:
    """Notes on the group's method, each sentence once."""
    infos = (info for name in group.objects for _, info in group.entries(name))
    return list(dict.fromkeys(note for info in infos for note in info.notes.get(group.method, [])))


def _test_part(groups: Sequence[Group]) -> str:
    """A sentence on the test part with trials and looks of every row; empty where no figure is of a test part."""
    told, others = [], []
    for group in groups:
        tested = [run.state for run in group.evaluated if run.state.get("part") == "test"]
        if tested:
            trials, looks = (_range([state.get(key) for state in tested]) for key in ("trials", "looks"))
            told.append(f"{group.label}: {counted(trials, 'trial')}, {counted(looks, 'test evaluation')}")
        others += [group.label] if len(tested) < len(group.evaluated) else []
    if not told:
        return ""
    more = f" Not of a test part: {', '.join(others)}." if others else ""
    return (
        "Figures of the test part, on which nothing was tuned; declared trials on the development part and "
        f"test evaluations: {'; '.join(told)}.{more}"
    )


def counted(number: int | str, noun: str) -> str:
    """The number with its noun, in the singular or plural."""
    return f"{number} {noun}" if str(number) == "1" else f"{number} {noun}s"


def _range(values: Sequence[Any]) -> str:
    known = sorted({str(v) for v in values})
    return known[0] if len(known) == 1 else f"{known[0]} to {known[-1]}"
