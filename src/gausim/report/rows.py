"""Rows of a report: runs of one configuration, whatever their seeds and objects, named after model and ablation."""

import json
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

from gausim.report.runs import INIT_FROM, RunRecord
from gausim.runs.choices import dig

FULL = "full"
# Names of ablations in tables, in the paper's order of rows; others keep theirs and follow.
ABLATIONS = {
    "joint": "jointly", "no_network": "w/o network", "no_mass": "w/o mass", "no_momentum": "w/o momentum",
    "no_hierarchy": "w/o hierarchy",
}  # fmt: skip
# Settings that select the object of a run.
_WHICH_OBJECT = ("data.root", "data.names", "data.scene", "data.masks", "data.selections", "data.test")
# Largest number of differing settings in a row's name or a note.
_KEYS_IN_NAMES = 3

# The runs of a row by object; they differ by their seeds.
About = dict[str, list[RunRecord]]


class RowName(NamedTuple):
    """Name of a row."""

    label: str  # of the tables
    family: str  # the model's name, without the variation
    variation: str  # the varied settings


def make_rows(runs: Sequence[RunRecord]) -> list[tuple[RowName, About]]:
    """Joins runs of one name: those that differ by their seed, and on different objects by any setting.

    Where a name has several configurations on one object, each is a row of its own.
    """
    named: dict[RowName, dict[str, About]] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for run in runs:
        names = _objects(run, runs)
        # A run without a configuration is a separate row.
        key = json.dumps(besides_object(run), sort_keys=True) if run.config else str(run.path)
        for name in names:
            named[_name(run, len(names))][key][name].append(run)
    rows = []
    for row, configurations in named.items():
        own = list(configurations.values())
        every = [one for about in own for one in about]
        if len(set(every)) == len(every):
            rows.append((row, {one: found for about in own for one, found in about.items()}))
            continue
        for about in own:
            rivals = [other for other in own if other is not about]
            pairs = [(found[0], r[one][0]) for one, found in about.items() for r in rivals if one in r]
            tag = _difference(pairs) if pairs else next(iter(about.values()))[0].given_name
            variation = tag if row.variation == FULL else f"{row.variation} ({tag})"
            rows.append((RowName(f"{row.label} ({tag})", row.family, variation), dict(about)))
    return rows


def besides_object(run: RunRecord) -> dict[str, str]:
    """The settings that do not select the object: names of sequences do, their number does not."""
    taken = (INIT_FROM,) if dig(run.config, "model", "method") else ()
    found = run.settings_besides((*_WHICH_OBJECT, *taken))
    return {k: v for k, v in found.items() if k != "data.sequences" or not v.startswith("[")}


def _objects(run: RunRecord, runs: Sequence[RunRecord]) -> list[str]:
    """Objects of a run: from its summary, else from a run on the same data, else the data's directory."""
    names, root = _data(run)
    for known in (run, *(r for r in runs if _data(r) == (names, root))):
        if known.objects:
            return list(known.objects)
    if isinstance(names, list) and names:
        return [str(n) for n in names]
    roots = root if isinstance(root, list) else [root]
    return [str(r.get("root", "?") if isinstance(r, dict) else r).rstrip("/").rsplit("/", 1)[-1] for r in roots]


def _data(run: RunRecord) -> tuple[Any, Any]:
    data = run.config.get("data")
    return (data.get("names"), data.get("root", "?")) if isinstance(data, dict) else (None, "?")


def _name(run: RunRecord, objects: int) -> RowName:
    family = run.choices.get("model") or run.given_name
    parts = [part for part in str(dig(run.config, "ablation", "name") or "none").split("+") if part != "none"]
    if objects > 1 and "joint" not in parts:
        parts.insert(0, "joint")
    variation = ", ".join(ABLATIONS.get(part, part) for part in parts) or FULL
    return RowName(f"{family} {variation}" if parts else family, family, variation)


def _difference(pairs: Sequence[tuple[RunRecord, RunRecord]]) -> str:
    """What distinguishes the first of two runs on one object, in all pairs: its name, or its own settings."""
    first = pairs[0][0]
    if all(rival.given_name != run.given_name for run, rival in pairs):
        return first.given_name
    own = {key: run.settings[key] for run, rival in pairs for key in differing(run.settings, rival.settings)}
    return first_few([f"{key.rsplit('.', 1)[-1]}={own[key]}" for key in sorted(own)]) or first.name


def differing(own: dict[str, str], other: dict[str, str]) -> list[str]:
    """Keys of the settings that another run has not or has otherwise, without names and folders."""
    return [key for key in own if other.get(key) != own[key] and not key.endswith(("name", "root"))]


def first_few(items: Sequence[str]) -> str:
    """The first few settings as text, and how many more there are."""
    more = [f"{len(items) - _KEYS_IN_NAMES} more"] if len(items) > _KEYS_IN_NAMES else []
    return ", ".join([*items[:_KEYS_IN_NAMES], *more])
