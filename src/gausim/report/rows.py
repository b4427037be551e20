"""Rows of a report: runs of one configuration, whatever their seeds and objects, named after that configuration."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

from gausim.report.runs import INIT_FROM, RunRecord, dig

T = TypeVar("T")
FULL = "full"
# Settings that select the object of a run.
_WHICH_OBJECT = ("data.root", "data.names", "data.scene", "data.masks", "data.selections", "data.test")
# Largest number of differing settings in a row's name or a note.
_KEYS_IN_NAMES = 3
# Ablations that are identified by the settings.
_SWITCHES = ("no_network", "no_mass", "no_momentum", "no_hierarchy")

# The runs of a row, by their objects.
About = dict[tuple[str, ...], tuple[RunRecord, ...]]


class RowName(NamedTuple):
    """Name of a row."""

    label: str  # of the tables
    family: str  # the model's name, without the variation
    variation: str  # the varied settings


def make_rows(runs: Sequence[RunRecord]) -> list[tuple[RowName, About]]:
    """Joins runs that differ by their seed or their single object, and names them; joint runs are separate rows."""
    by_config: dict[str, list[RunRecord]] = {}
    for run in runs:
        # A run without a configuration is a separate row.
        key = json.dumps(run.settings, sort_keys=True) if run.config else str(run.path)
        by_config.setdefault(key, []).append(run)
    configurations = []
    for same in by_config.values():
        first, names = same[0], _objects(same, runs)
        key = json.dumps(besides_object(first), sort_keys=True) if first.config and len(names) == 1 else str(first.path)
        configurations.append((key, {names: tuple(same)}))
    rows = [about for _, about in _joined(configurations)]
    named = [_name(_first(about), max(map(len, about))) for about in rows]
    # Equally named rows of different objects are of a method whose settings were chosen for each object.
    return _joined(zip(_distinct(named, rows), rows, strict=True))


def _joined(rows: Iterable[tuple[T, About]]) -> list[tuple[T, About]]:
    """Joins rows of equal keys and different objects."""
    joined: list[tuple[T, About]] = []
    for key, about in rows:
        own = {name for names in about for name in names}
        free = (row for known, row in joined if known == key and not any(own.intersection(names) for names in row))
        row = next(free, None)
        if row is None:
            joined.append((key, dict(about)))
        else:
            row.update(about)
    return joined


def _first(about: About) -> RunRecord:
    return next(iter(about.values()))[0]


def besides_object(run: RunRecord) -> dict[str, str]:
    """The settings that do not select the object: names of sequences do, their number does not.

    What a fitted method takes over was found on its object.
    """
    taken = (INIT_FROM,) if dig(run.config, "model", "method") else ()
    found = run.settings_besides((*_WHICH_OBJECT, *taken))
    return {k: v for k, v in found.items() if k != "data.sequences" or not v.startswith("[")}


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


def _name(run: RunRecord, objects: int) -> RowName:
    """Name from the settings of the configuration, not from the name of the run."""
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
    return RowName(f"{family} {variation}" if varied else family, family, variation)


def _distinct(names: Sequence[RowName], rows: Sequence[About]) -> list[RowName]:
    """Distinguishes equal names of two configurations on one object by the run's name or by settings.

    Of several full configurations, the reference of the ablations keeps the plain name.
    """
    objects = [{o: same[0] for together, same in about.items() for o in together} for about in rows]
    taken = Counter((name, o) for name, own in zip(names, objects, strict=True) for o in own)
    plain = {_reference(name.family, names, [_first(about) for about in rows]) for name in names}
    result = []
    for i, name in enumerate(names):
        if i not in plain and any(taken[name, o] > 1 for o in objects[i]):
            rivals = [other for j, other in enumerate(objects) if names[j] == name and j != i]
            tag = _difference([(run, other[o]) for o, run in objects[i].items() for other in rivals if o in other])
            variation = tag if name.variation == FULL else f"{name.variation} ({tag})"
            name = RowName(f"{name.label} ({tag})", name.family, variation)
        result.append(name)
    return result


def _reference(family: str, names: Sequence[RowName], firsts: Sequence[RunRecord]) -> int | None:
    """The full configuration that differs least from the family's ablations; None without one, or in a tie."""
    full = [i for i, name in enumerate(names) if (name.family, name.variation) == (family, FULL)]
    ablated = [firsts[i].settings for i, name in enumerate(names) if name.family == family and i not in full]
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
    own = {key: run.settings[key] for run, rival in pairs for key in differing(run.settings, rival.settings)}
    return first_few([f"{key.rsplit('.', 1)[-1]}={own[key]}" for key in sorted(own)]) or first.name


def differing(own: dict[str, str], other: dict[str, str]) -> list[str]:
    """Keys of the settings that another run has not or has otherwise, without names and folders."""
    return [key for key in own if other.get(key) != own[key] and not key.endswith(("name", "root"))]


def first_few(items: Sequence[str]) -> str:
    """The first few settings as text, and how many more there are."""
    more = [f"{len(items) - _KEYS_IN_NAMES} more"] if len(items) > _KEYS_IN_NAMES else []
    return ", ".join([*items[:_KEYS_IN_NAMES], *more])
