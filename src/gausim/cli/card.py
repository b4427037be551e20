"""`gausim card RUN`: the card of a run for its users, made from the records in its directory."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gausim.cli.arguments import add_data_option, command_parser
from gausim.compose.data_paths import data_option, listed, located
from gausim.core.errors import ConfigError, DataError, RunError

if TYPE_CHECKING:
    from gausim.report.card import CardFacts
    from gausim.report.gather.runs import RunRecord

# Groups of the configuration with a choice per run; others concern paths and display.
_GROUPS = (
    "data", "model", "supervision", "loss", "optimizer", "render", "trainer", "logger", "callbacks", "budget",
    "experiment", "ablation",
)  # fmt: skip
# Keys omitted from cards: paths of the training machine, and keys without effect on the run or its figures.
_PATHS = ("data.root", "data.scene", "data.masks", "paths")
_UNTOLD = (
    *_PATHS, "data.seed", "logger", "callbacks", "name", "task_name", "evaluate", "trainer.progress", "ablation",
    "experiment",
)  # fmt: skip
_ABSENT = "(absent)"


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    from gausim.io.files import write_durably
    from gausim.report.card import CARD, card

    run = _record(arguments.run)
    path = arguments.out or arguments.run / CARD
    if path.exists() and not arguments.force:
        raise RunError(f"{path}: is there already, perhaps with manual edits. --force replaces it, --out FILE writes "
                       "elsewhere.")  # fmt: skip
    write_durably(path, card(run, _facts(run, arguments)).encode())
    print(f"wrote {path}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "card",
        " Markdown with the front matter of Hugging Face, from what the run's directory records; what is missing is "
        "named with the command that makes it.",
    )
    add = parser.add_argument
    add("run", metavar="RUN", type=Path, help="run directory of `gausim train`")
    add("--licence", metavar="ID", help="under which others may use the run, e.g. CC-BY-4.0")
    add_data_option(parser)
    add("--out", metavar="FILE", type=Path, help="default RUN/README.md")
    add("--force", action="store_true", help="replace an existing card")
    return parser


def _record(folder: Path) -> RunRecord:
    from gausim.report.gather.runs import BROKEN, find_runs

    found = find_runs([folder])
    if [run.path for run in found] != [folder]:
        raise RunError(f"{folder}: expected one run directory, found {len(found)} below it. Name one of them.")
    if found[0].status == BROKEN:
        raise RunError(found[0].detail)
    return found[0]


def _facts(run: RunRecord, arguments: argparse.Namespace) -> CardFacts:
    from gausim.report.card import CardFacts
    from gausim.runs.directory import RunDirectory

    directory = RunDirectory(run.path)
    base, differences = _differences(run)
    return CardFacts(
        command=str(arguments.run),
        about=_about(run.choices.get("model")),
        data=_data(run, arguments.data),
        base=base,
        differences=differences,
        overrides=_overrides(run.path),
        finished=directory.facts() if directory.is_finished else {},
        endurance=_endurance(run.path / "evaluation" / "endurance.json"),
        licence=arguments.licence,
    )


def _data(run: RunRecord, words: list[str]) -> dict[str, Mapping[str, Any]] | None:
    """Content of ``dataset.json`` per object; None if the data set is not on this machine."""
    from gausim.data.objects import find_objects
    from gausim.io.transforms import read_json

    data: Mapping[str, Any] = run.config.get("data", {})
    try:
        roots = located(run.path, data, data_option(words))["root"]
        places = [root["root"] if isinstance(root, Mapping) else root for root in listed(roots) if root is not None]
        every = [(folder, read_json(folder / "dataset.json")) for place in places for folder in find_objects(place)]
    except DataError:
        if words:
            raise
        return None
    facts = {str(said.get("name", folder.name)): said for folder, said in every}
    return {name: said for name, said in facts.items() if name in (data.get("names") or facts)}


def _endurance(path: Path) -> dict[str, Any]:
    from gausim.io.plain_json import parse_json

    if not path.is_file():
        return {}
    try:
        return dict(parse_json(path.read_bytes()))
    except (OSError, ValueError, TypeError) as error:
        raise RunError(
            f"{path}: cannot be read ({error}). Run `gausim evaluate RUN --endurance 1000` again."
        ) from error


def _about(preset: str | None) -> str:
    """The comment at the head of a model's file in conf/."""
    from gausim.compose.config import conf_dir

    path = conf_dir() / "model" / f"{preset}.yaml"
    if preset is None or not path.is_file():
        return ""
    head = takewhile(lambda line: line.startswith("#"), path.read_text().splitlines())
    return " ".join(line.lstrip("# ").strip() for line in head)


def _overrides(folder: Path) -> list[str]:
    import yaml

    try:
        said = yaml.safe_load((folder / ".hydra" / "overrides.yaml").read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return []
    words = [(str(word), str(word).partition("=")[0]) for word in said] if isinstance(said, list) else []
    return [f"{key}=..." if _is_one_of(key, _PATHS) else word for word, key in words]


def _is_one_of(key: str, keys: Sequence[str]) -> bool:
    return any(key == one or key.startswith((f"{one}.", f"{one}[")) for one in keys)


def _differences(run: RunRecord) -> tuple[str, list[tuple[str, str, str]]]:
    """The configuration for comparison, and every key that differs."""
    from omegaconf import OmegaConf

    import gausim
    from gausim.compose.config import compose
    from gausim.runs.defaults import flatten, with_defaults

    chosen = [f"{group}={run.choices[group]}" for group in _GROUPS if run.choices.get(group) not in (None, "None")]
    words = f"`gausim train {' '.join(chosen)}`" if chosen else "`gausim train`"
    try:
        default = compose("train", chosen)
    except ConfigError:  # a file of an earlier version
        default, words = compose("train"), "`gausim train` (its own presets are not of this version)"
    base_config = OmegaConf.to_container(default, resolve=True)
    own, base = ({key: str(value) for key, value in flatten(with_defaults(config))}
                 for config in (run.config, base_config))  # fmt: skip
    keys = [key for key in own if own[key] != base.get(key)] + [key for key in base if key not in own]
    rows = [(k, own.get(k, _ABSENT), base.get(k, _ABSENT)) for k in keys if not _is_one_of(k, _UNTOLD)]
    rows = [row for row in rows if {*row[1:]} != {"None", _ABSENT}]  # null and absent mean the same
    return f"{words} of gausim {gausim.__version__}", rows
