"""The card of a run: Markdown with front matter, from what its directory records; nothing is measured or guessed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml

from gausim.report.gather.runs import RunRecord
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
    name = f"{run.config.get('name')}, seed {run.seed}"
    sections = {
        "Data": _data(run, facts),
        "Figures": _figures(run, facts),
        "Training": _training(run, facts),
        "Versions": _versions(run, facts),
        "Configuration": _configuration(facts),
        "Limitations": [f"* {sentence}" for sentence in _limitations(run, facts)],
        "Licence": _licence(facts),
        "Loading": _loading(run, facts),
    }
    parts = [_front_matter(run, facts), f"# {name}", "", *_what(run, facts)]
    for title, lines in sections.items():
        parts += ["", f"## {title}", "", *lines]
    return "\n".join(parts).rstrip() + "\n"


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
    return f"---\n{yaml.safe_dump(head, sort_keys=False, allow_unicode=True)}---\n"


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
    found: Any = entry["rows"]
    for key in (row, split, group, metric):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def _frames(entry: dict[str, Any], split: str) -> str:
    start, stop = entry["splits"][split]
    return f"{split} frames {start}..{stop - 1}"


def _what(run: RunRecord, facts: CardFacts) -> list[str]:
    names = list(_objects(run)) or list(facts.data or ()) or list(run.config.get("data", {}).get("names") or ())
    preset = run.choices.get("model")
    lines = [
        "Weights of a run of gausim: from the first frames of multi-view videos of an "
        f"elastic object made of 3D Gaussians it predicts how the object goes on to move. Trained on: "
        f"{', '.join(names) or 'missing, see Data'}.",
    ]
    if facts.about:
        lines += ["", f"Model `{preset}`: {facts.about}"]
    rows = []
    for name, entry in _objects(run).items():
        levels = entry.get("efficiency", {}).get(_method(entry), {}).get("levels")
        if levels:
            counts = " / ".join(str(count) for count in levels["counts"])
            rows.append([name, _method(entry), counts, str(levels["predictions"])])
    if rows:
        lines += ["", _table(["object", "method", "kernels / units per level", "predictions per step"], rows)]
    return lines


def _data(run: RunRecord, facts: CardFacts) -> list[str]:
    rows = [_data_row(name, entry, facts) for name, entry in _objects(run).items()]
    lines = []
    if rows:
        head = ["object", "sequences", "frames", "trained on frames", "views trained on", "views held out", "licence"]
        lines += [_table(head, rows), ""]
        lines += [line for name, entry in _objects(run).items() for line in _hashes(name, entry)]
    else:
        lines.append(f"Missing: sequences and views. `gausim evaluate {facts.command}` records them.")
    if facts.data is None:
        lines.append(
            f"Missing: what `dataset.json` says. The data set is not where the run was trained; `gausim card "
            f"{facts.command} --data DIR` reads it elsewhere."
        )
    return lines


def _data_row(name: str, entry: dict[str, Any], facts: CardFacts) -> list[str]:
    frames = sorted(set(entry["frames"]))
    span = f"{frames[0]}" if len(frames) == 1 else f"{frames[0]} to {frames[-1]}"
    start, stop = entry["splits"]["seen"]
    licence = "unknown" if facts.data is None else _data_licence(facts.data.get(name, {}))
    return [
        name,
        str(len(entry["sequences"])),
        f"{span} at {entry['fps']:g} fps",
        f"{start}..{stop - 1}",
        ", ".join(entry["train_views"]) or "none",
        ", ".join(entry["heldout_views"]) or "none",
        licence,
    ]


def _data_licence(said_of_it: Mapping[str, Any]) -> str:
    found = next((said_of_it[key] for key in _LICENCES if isinstance(said_of_it.get(key), str)), None)
    return found or "missing (field `licence` of `dataset.json`)"


def _hashes(name: str, entry: dict[str, Any]) -> Iterator[str]:
    sources = entry.get("sources", {})
    known = {key: sources[key] for key in ("scene", "masks", "manifest") if sources.get(key, {}).get("sha256")}
    if known:
        yield f"SHA-256 of the files of {name}: " + ", ".join(f"{v['file']} `{v['sha256']}`" for v in known.values())
        yield ""


def _figures(run: RunRecord, facts: CardFacts) -> list[str]:
    if run.summary is None:
        return [f"Missing. `gausim evaluate {facts.command}` measures them."]
    said_of_run = run.summary["run"]
    lines = [
        f"Measured by `gausim evaluate` (views {said_of_run.get('views')}) with the checkpoint of epoch "
        f"{said_of_run.get('epoch')}, {said_of_run.get('updates')} updates. {LEGEND}",
    ]
    for name, entry in _objects(run).items():
        for table in object_tables(name, entry):
            lines += ["", markdown_table(table).rstrip()]
        lines += _speed(name, entry)
        lines += [f"\n{name}, {line}" for line in _far(facts.endurance.get(name, {}))]
    return lines


def _far(rollouts: Mapping[str, Any]) -> Iterator[str]:
    for kind, told in rollouts.items():
        frames = len(told["energy"]) * told["window"]
        yield (
            f"{kind} for {frames} frames: its highest energy later is {told['growth']:.2f} of the highest before, and "
            f"the last tenth of the frames holds {told['late']:.2g} of the highest of all."
        )


def _speed(name: str, entry: dict[str, Any]) -> list[str]:
    cost = entry.get("efficiency", {}).get(_method(entry))
    if not cost:
        return []
    return [
        "",
        f"{name}: {cost['seconds_per_frame']['mean'] * 1e3:.1f} ms per predicted frame ({cost['device']}, "
        f"{cost['threads']} threads), drawing not counted.",
    ]


def _training(run: RunRecord, facts: CardFacts) -> list[str]:
    first = next(iter(_objects(run).values()), None)
    fit = None if first is None else said(first, _method(first)).get("fit")
    trainer = run.config.get("trainer", {})
    lines = []
    if facts.finished:
        lines.append(f"{facts.finished.get('epochs')} epochs, {facts.finished.get('optimizer_steps')} optimiser steps.")
    else:
        lines.append(f"Not finished: {run.detail or run.status}. The command that began it continues it.")
    asked = [f"{key} {trainer[key]}" for key in ("accelerator", "devices", "threads", "precision") if key in trainer]
    lines.append(f"Asked for: {', '.join(asked)}.")
    if isinstance(fit, Mapping):
        lines.append(
            f"It took {fit['seconds'] / 60:.1f} minutes, {fit['cpu_seconds'] / 60:.1f} minutes of processor time, and "
            f"held {fit['peak_bytes'] / 1e9:.2f} GB at most."
        )
    else:
        lines.append(
            f"Missing: time and memory. `gausim evaluate {facts.command}` records those that training counted."
        )
    return lines


def _versions(run: RunRecord, facts: CardFacts) -> list[str]:
    known = (run.summary or {}).get("provenance")
    if not known:
        return [f"Missing. `gausim evaluate {facts.command}` records them."]
    commit = known.get("commit")
    state = {True: ", with changes that are in no commit", False: ""}.get(known.get("modified"), "")
    where = f"commit `{commit}`{state}" if commit else "commit unknown: it was installed from a package"
    return [
        f"Evaluated with gausim {known.get('gausim')} ({where}), torch {known.get('torch')}, Python "
        f"{known.get('python')}. A run does not record with which version it was trained."
    ]


def _configuration(facts: CardFacts) -> list[str]:
    lines = []
    if facts.overrides:
        lines += ["Started by", "", "```", "gausim train " + " ".join(facts.overrides), "```", ""]
    if not facts.base:
        return [*lines, "Missing: the differences from the default; config.yaml has all settings."]
    if not facts.differences:
        return [*lines, f"No difference from {facts.base}."]
    rows = [[f"`{key}`", f"`{own}`", f"`{base}`"] for key, own, base in facts.differences]
    return [*lines, f"Differences from {facts.base}:", "", _table(["key", "this run", "default"], rows)]


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


def _licence(facts: CardFacts) -> list[str]:
    if facts.licence:
        return [f"{facts.licence}, for the files of this run; the data set has a licence of its own (see Data)."]
    return [f"Missing. `gausim card {facts.command} --licence ID` states it."]


def _loading(run: RunRecord, facts: CardFacts) -> list[str]:
    preset = f" model={run.choices['model']}" if run.choices.get("model") else ""
    return [
        "The run's directory and its data set (DIR) are needed; nothing in them is executed.",
        "",
        "```",
        f"gausim evaluate {facts.command} --data DIR",
        f"gausim simulate {facts.command} --data DIR --gif",
        f"gausim train{preset} data=object data.root=NEW init_from={facts.command} name=new   # another object",
        "```",
        "",
        "```python",
        "import gausim",
        "",
        f'simulation = gausim.load("{facts.command}", data={{"root": "DIR"}})',
        "```",
    ]


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
