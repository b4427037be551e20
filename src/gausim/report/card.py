"""Card of a run: Markdown with front matter, from the records in its directory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml
from jinja2 import Environment, PackageLoader

from gausim.report.gather.runs import RunRecord
from gausim.results.summary import MOTION_ENERGY, dig
from gausim.results.table import (
    GROUP_TITLES,
    LEGEND,
    NO_FORESIGHT,
    footnotes_of,
    markdown_table,
    object_tables,
    reference_row,
)

# Hugging Face and code hosts display a file of this name.
CARD = "README.md"
TAGS = ("gaussian-splatting", "neural-simulation", "elastic-dynamics", "3d")
_LICENCES = ("licence", "license")
_SOURCES = ("scene", "masks", "manifest")  # files of an object's data whose hashes are told
# Figure of each group in the front matter and in the limitations.
_HEADLINES = {"points": "error_3d", "heldout": "l2", "train": "l2"}


@dataclass(frozen=True)
class CardFacts:
    """Contents of a card beyond the run's records."""

    command: str  # the run's directory as written in commands
    about: str = ""  # description of the model's preset
    data: Mapping[str, Mapping[str, Any]] | None = None  # dataset.json by object, if the data set is available
    base: str = ""  # reference of the comparison of configurations, in words
    differences: Sequence[tuple[str, str, str]] = ()  # key, value of the run and value of that base
    overrides: Sequence[str] = ()  # overrides of its command, without paths
    finished: Mapping[str, Any] = field(default_factory=dict)  # content of FINISHED
    endurance: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # content of endurance.json
    licence: str | None = None  # of the weights


def card(run: RunRecord, facts: CardFacts) -> str:
    """The card of a run, with the commands that make missing parts."""
    environment = Environment(
        loader=PackageLoader("gausim.report"), trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters["cell"] = lambda text: text.replace("|", "\\|")
    objects = run.objects
    data, trainer = run.config.get("data", {}), run.config.get("trainer", {})
    costs = {name: dig(entry, "efficiency", _method(entry)) for name, entry in objects.items()}
    first: dict[str, Any] = next(iter(objects.values()), {"methods": []})
    fit = footnotes_of(first, _method(first)).get("fit")
    sources = {name: [dig(entry, "sources", key) for key in _SOURCES] for name, entry in objects.items()}
    hashes = {name: [file for file in files if dig(file, "sha256")] for name, files in sources.items()}
    return environment.get_template("card.md").render(
        run=run,
        facts=facts,
        objects=objects,
        front_matter=_front_matter(run, facts),
        names=list(objects) or list(facts.data or ()) or list(data.get("names") or ()),
        levels={name: found for name, cost in costs.items() if (found := dig(cost, "levels"))},
        costs=costs,
        licence_of=lambda name: _data_licence(facts, name),
        hashes={name: files for name, files in hashes.items() if files},
        legend=LEGEND,
        tables=lambda name, entry: [markdown_table(table) for table in object_tables(name, entry)],
        asked=[f"{key} {trainer[key]}" for key in ("accelerator", "devices", "threads", "precision") if key in trainer],
        fit=fit if isinstance(fit, Mapping) else None,
        headline=_headline,
        footnotes_of=lambda entry: footnotes_of(entry, _method(entry)),
        no_foresight=NO_FORESIGHT,
    )


def _data_licence(facts: CardFacts, name: str) -> str:
    if facts.data is None:
        return "unknown"
    found = (facts.data.get(name, {}).get(key) for key in _LICENCES)
    return next((one for one in found if isinstance(one, str)), "missing (field `licence` of `dataset.json`)")


def _front_matter(run: RunRecord, facts: CardFacts) -> str:
    results = [
        {
            "task": {"type": "other", "name": "predicting the motion of an elastic object"},
            "dataset": {"type": name, "name": name},
            "metrics": metrics,
        }
        for name, entry in run.objects.items()
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
            mean = dig(entry["rows"], _method(entry), split, group, metric, "mean")
            if mean is not None:
                info, (start, stop) = entry["metrics"][metric], entry["splits"][split]
                frames = f"{split} frames {start}..{stop - 1}"
                yield {
                    "type": metric,
                    "name": f"{info['label']} [{info['unit']}], {frames}, {GROUP_TITLES[group]}",
                    "value": round(mean * info["scale"], 4),
                }


def _headline(entry: dict[str, Any]) -> dict[str, Any] | None:
    """Figures of the unseen frames for the limitations: ratios to the reference, and energy."""
    row = entry["rows"].get(_method(entry), {})
    for group, metric in _HEADLINES.items():
        if dig(row, "unseen", group, metric, "mean") is not None:
            return {
                "label": entry["metrics"][metric]["label"],
                "where": GROUP_TITLES[group],
                "reference": reference_row(entry),
                "ratios": [dig(row, split, group, metric, "ratio") for split in ("seen", "unseen")],
                "energy": dig(row, "unseen", group, MOTION_ENERGY, "pooled"),
            }
    return None


def _method(entry: dict[str, Any]) -> str:
    return str(entry["methods"][0]) if entry["methods"] else ""
