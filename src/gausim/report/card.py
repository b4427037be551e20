"""The card of a run: Markdown with front matter, from what its directory records; nothing is measured or guessed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml
from jinja2 import Environment, PackageLoader

from gausim.report.gather.runs import RunRecord, dig
from gausim.results.summary import MOTION_ENERGY
from gausim.results.table import GROUP_TITLES, LEGEND, NO_FORESIGHT, markdown_table, object_tables, said

# Hugging Face and code hosts show a file of this name.
CARD = "README.md"
TAGS = ("gaussian-splatting", "neural-simulation", "elastic-dynamics", "3d")
_LICENCES = ("licence", "license")
# The figure of a group that stands in the front matter and that the limitations speak of.
_HEADLINES = {"points": "error_3d", "heldout": "l2", "train": "l2"}


@dataclass(frozen=True)
class CardFacts:
    """What a card says beyond the run's own records.

    Attributes:
        command: how the run's directory is written in commands.
        about: what its model's preset says of itself; empty where it is unknown.
        data: content of ``dataset.json`` by object; None where the data set is not on this machine.
        base: what its configuration is compared with, in words.
        differences: key, value of the run and value of that base.
        overrides: what it was started with, paths of that machine left out.
        finished: content of ``FINISHED``; empty for an unfinished run.
        endurance: content of ``evaluation/endurance.json``; empty where long rollouts were not measured.
        licence: of the weights; None where nobody has said it.
    """

    command: str
    about: str = ""
    data: Mapping[str, Mapping[str, Any]] | None = None
    base: str = ""
    differences: Sequence[tuple[str, str, str]] = ()
    overrides: Sequence[str] = ()
    finished: Mapping[str, Any] = field(default_factory=dict)
    endurance: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    licence: str | None = None


def card(run: RunRecord, facts: CardFacts) -> str:
    """The card of a run; parts that are missing are named, with the command that makes them."""
    environment = Environment(
        loader=PackageLoader("gausim.report"), trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters["cell"] = lambda text: text.replace("|", "\\|")
    objects = _objects(run)
    data, trainer = run.config.get("data", {}), run.config.get("trainer", {})
    costs = {name: dig(entry, "efficiency", _method(entry)) for name, entry in objects.items()}
    first = next(iter(objects.values()), None)
    fit = None if first is None else said(first, _method(first)).get("fit")
    return environment.get_template("card.md").render(
        run=run,
        facts=facts,
        objects=objects,
        front_matter=_front_matter(run, facts),
        names=list(objects) or list(facts.data or ()) or list(data.get("names") or ()),
        levels={name: found for name, cost in costs.items() if (found := dig(cost, "levels"))},
        costs=costs,
        licence_of=lambda name: _data_licence(facts, name),
        hashes={name: found for name, entry in objects.items() if (found := _hashed(entry))},
        legend=LEGEND,
        tables=lambda name, entry: [markdown_table(table) for table in object_tables(name, entry)],
        asked=[f"{key} {trainer[key]}" for key in ("accelerator", "devices", "threads", "precision") if key in trainer],
        fit=fit if isinstance(fit, Mapping) else None,
        limitations=list(_limitations(run, facts)),
    )


def _data_licence(facts: CardFacts, name: str) -> str:
    if facts.data is None:
        return "unknown"
    found = (facts.data.get(name, {}).get(key) for key in _LICENCES)
    return next((one for one in found if isinstance(one, str)), "missing (field `licence` of `dataset.json`)")


def _hashed(entry: dict[str, Any]) -> list[dict[str, Any]]:
    """The files of an object's data whose hashes are known."""
    found = [dig(entry, "sources", key) for key in ("scene", "masks", "manifest")]
    return [file for file in found if dig(file, "sha256")]


def _objects(run: RunRecord) -> dict[str, Any]:
    return {} if run.summary is None else run.summary["objects"]


def _front_matter(run: RunRecord, facts: CardFacts) -> str:
    results = [
        {
            "task": {"type": "other", "name": "predicting the motion of an elastic object"},
            "dataset": {"type": name, "name": name},
            "metrics": metrics,
        }
        for name, entry in _objects(run).items()
        if (metrics := list(_headline_metrics(entry)))
    ]
    head: dict[str, Any] = {"license": facts.licence.lower()} if facts.licence else {}
    head |= {"library_name": "gausim", "tags": list(TAGS)}
    if results:
        head["model-index"] = [{"name": f"{run.config.get('name')}-{run.seed}", "results": results}]
    return yaml.safe_dump(head, sort_keys=False, allow_unicode=True)


def _headline_metrics(entry: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for split in ("seen", "unseen"):
        for group, metric in _HEADLINES.items():
            mean = _cell(entry, _method(entry), split, group, metric).get("mean")
            if mean is not None:
                info = entry["metrics"][metric]
                yield {
                    "type": metric,
                    "name": f"{info['label']} [{info['unit']}], {_frames(entry, split)}, {GROUP_TITLES[group]}",
                    "value": round(mean * info["scale"], 4),
                }


def _method(entry: dict[str, Any]) -> str:
    return str(entry["methods"][0]) if entry["methods"] else ""


def _cell(entry: dict[str, Any], row: str, split: str, group: str, metric: str) -> Mapping[str, Any]:
    return dig(entry["rows"], row, split, group, metric) or {}


def _frames(entry: dict[str, Any], split: str) -> str:
    start, stop = entry["splits"][split]
    return f"{split} frames {start}..{stop - 1}"


def _limitations(run: RunRecord, facts: CardFacts) -> Iterator[str]:
    names = ", ".join(_objects(run)) or "its own objects"
    yield (
        f"It knows {names} and the sequences that it was trained on. New pushes of the same object need `gausim "
        "adapt`; another object needs a training of its own, which may start from this network (`init_from`)."
    )
    yield f"It is one training, with seed {run.seed}; how far seeds differ is not in this card."
    if not facts.finished:
        yield "Its training is not finished."
    if run.summary is None:
        yield "How well it predicts is not known: it was not evaluated."
    for name, entry in _objects(run).items():
        yield from _of_object(name, entry, facts)
    if not facts.endurance:
        yield (
            "How it goes on beyond the recorded frames, and how it answers to forces, was not measured "
            f"(`gausim evaluate {facts.command} --endurance 1000`)."
        )


def _of_object(name: str, entry: dict[str, Any], facts: CardFacts) -> Iterator[str]:
    method = _method(entry)
    group = next(
        (g for g in _HEADLINES if _cell(entry, method, "unseen", g, _HEADLINES[g]).get("mean") is not None), ""
    )
    if group:
        label = entry["metrics"][_HEADLINES[group]]["label"]
        ratios = [_cell(entry, method, split, group, _HEADLINES[group]).get("ratio") for split in ("seen", "unseen")]
        if None not in ratios:
            yield (
                f"{name}: in {_frames(entry, 'unseen')} its {label} ({GROUP_TITLES[group]}) is {ratios[1]:.2f} of what "
                f"standing still has, in the seen ones {ratios[0]:.2f}."
            )
        energy = _cell(entry, method, "unseen", group, MOTION_ENERGY).get("pooled")
        if energy is not None:
            yield f"{name}: its motion there has {energy:.2f} of the true motion's energy."
    if "points" not in entry["rows"].get(method, {}).get("seen", {}):
        yield f"{name}: the true motion in 3D is not known, so it was measured in images only."
    if not entry["heldout_views"]:
        yield f"{name}: no view was kept from training, so views from elsewhere were not measured."
    own = said(entry, method)
    if own.get("extrapolates") is False:
        yield f"{name}: {NO_FORESIGHT}"
    if isinstance(own.get("largest_eigenvalue"), float) and own["largest_eigenvalue"] > 1:
        yield (
            f"{name}: linearised at rest, the step lets small motions grow (largest eigenvalue "
            f"{own['largest_eigenvalue']:.4f})."
        )
    for metric, why in entry.get("absent", {}).items():
        yield f"{name}: {metric} was not computed ({why})."
    simulated = (facts.data or {}).get(name, {}).get("simulation")
    if isinstance(simulated, Mapping) and simulated.get("method"):
        yield f"{name}: its videos are computed ({simulated['method']}), not filmed."
