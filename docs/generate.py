"""A hook of MkDocs: writes the references of the configuration (from conf/) and of the commands (from their --help)."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from gausim.cli.main import COMMANDS, command
from gausim.cli.prepare import STAGES
from gausim.compose.places import Place, option_of, read_places
from gausim.compose.root import RootConfig, conf_dir
from gausim.compose.schema import documented

# Files of these groups set keys of any other group: one table each, of what they set.
RECIPES = {
    "experiment": "Experiments",
    "protocol": "Protocols",
    "method": "Methods of comparisons",
    "ablation": "Ablations",
    "budget": "Budgets",
    "sweep": "Sweeps",
}
GROUPS = ("data", "model", "supervision", "loss", "optimizer", "render", "trainer", "logger", "callbacks", "paths")
ROOT = Path(__file__).resolve().parents[1]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the generated pages to those of docs/."""
    for name, text in (("configuration", configuration()), ("commands", commands())):
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def configuration() -> str:
    """The page of all configuration groups, their files and their keys."""
    places = read_places()
    root = [(f"`{key}`", _cell(said)) for key, said in documented(RootConfig).items() if key not in GROUPS]
    parts = [
        "# Configuration",
        "`gausim train KEY=VALUE …` sets keys, `GROUP=FILE` chooses a file of a group. An experiment may replace any "
        "group, an ablation comes after it, and single keys of the command line come last. This page is made from "
        "`conf/`; `gausim train --cfg job` prints the whole configuration, `gausim config validate` checks one.",
        "## Root keys",
        *_table(("key", "meaning"), root),
    ]
    for group in GROUPS:
        parts.append(f"## {group}")
        for path in sorted((conf_dir() / group).glob("*.yaml")):
            parts += _file(path, places.children.get(group, Place()))
    for group, title in RECIPES.items():
        rows = [_recipe(path) for path in sorted((conf_dir() / group).rglob("*.yaml"))]
        parts += [f"## {title}", *_table((f"`{group}=`", "what it does", "what it sets"), rows)]
    parts.append("## What files begin with")
    for path in sorted((conf_dir() / "base").glob("*.yaml")):
        parts += _file(path, places)
    return "\n\n".join(parts)


def _file(path: Path, place: Place) -> Iterator[str]:
    """Title, head comment and table of one file's keys."""
    node, comments = yaml.safe_load(path.read_text()) or {}, _comments(path)
    yield f"### `{path.parent.name}={path.stem}`"
    yield _head(path)
    inherited = ", ".join(_begins_with(node))
    yield f"It begins with {inherited}." if inherited else ""
    rows = [(f"`{key}`", f"`{value}`", _cell(comments.get(key) or _meaning(place, key))) for key, value in _flat(node)]
    yield from _table(("key", "value", "meaning"), rows)


def _comments(path: Path) -> dict[str, str]:
    """The comments behind the keys of a file, by the keys' whole names."""
    lines, found = path.read_text().splitlines(), {}

    def read(node: yaml.Node | None, prefix: str) -> None:
        for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
            last = value if value.end_mark.line == key.start_mark.line else key
            comment = re.search(r"(?:^|[\s:])#\s*(.*)", lines[key.start_mark.line][last.end_mark.column :])
            found[prefix + key.value] = comment[1] if comment else ""
            read(value, f"{prefix}{key.value}.")

    read(yaml.compose("\n".join(lines)), "")
    return found


def _recipe(path: Path) -> tuple[str, str, str]:
    node, (group, name) = yaml.safe_load(path.read_text()) or {}, option_of(path)
    if group in ("ablation", "experiment"):
        node.pop(group, None)
    sets = [*_begins_with(node), *(f"`{key}={value}`" for key, value in _flat(node))]
    return f"`{name}`", _cell(_head(path)), "<br>".join(sets)


def _begins_with(node: dict[str, Any]) -> list[str]:
    """Takes the defaults list out of a file: its entries as one would write them on the command line."""
    entries = [e if isinstance(e, dict) else {e: ""} for e in node.pop("defaults", []) if e != "_self_"]
    pairs = [pair for entry in entries for pair in entry.items()]
    return [f"`{group.removeprefix('override ').lstrip('/')}{'=' * bool(name)}{name}`" for group, name in pairs]


def _head(path: Path) -> str:
    """The comment at the top of a file."""
    lines = [line[1:].strip() for line in path.read_text().splitlines() if line.startswith("#")]
    return " ".join(line for line in lines if "@package" not in line)


def _flat(node: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in node.items():
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{prefix}{key}.")
        elif key not in ("_partial_", "_recursive_", "_convert_"):
            text = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False)
            yield f"{prefix}{key}", _cell(text.removesuffix("...\n").strip())


def _meaning(place: Place, key: str) -> str:
    """What conf/ says of a key anywhere, else what the docstring of what is built says."""
    *above, last = key.split(".")
    for part in above:
        place = place.children.get(part, Place())
    said = place.children[last].comment if last in place.children else ""
    for target in (t for t in place.targets if t.startswith("gausim.")):
        found = pkgutil.resolve_name(target)
        said = said or {**documented(found), **documented(found.__init__)}.get(last, "")
    return said


def _cell(text: str) -> str:
    return re.sub(r"``(.+?)``", r"`\1`", text).replace("|", "\\|").replace("\n", " ")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows] if rows else []
    return ["\n".join(f"| {' | '.join(row)} |" for row in lines)]


def commands() -> str:
    """The page of all commands: their own words."""
    os.environ["COLUMNS"] = "100"
    sys.path.insert(0, str(ROOT))
    parts = [
        "# Commands",
        "What `gausim COMMAND --help` prints, then the stages of `gausim prepare`. The exit "
        "status is 0 where a command worked, 2 on wrong usage or unusable input, 130 when interrupted.",
    ]
    for name in COMMANDS:
        parts += _help(f"gausim {name}", command(name))
    for name in STAGES:
        main = importlib.import_module(f"data_prep.{name}").main
        parts += _help(f"gausim prepare {name}", main)
        for kind in getattr(sys.modules[main.__module__], "KINDS", ()):
            parts += _help(f"gausim prepare public {kind}", main, kind)
    return "\n\n".join(parts)


def _help(title: str, main: Callable[[list[str]], object], *before: str) -> list[str]:
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        main([*before, "--help"])
    return [f"## `{title}`", f"```text\n{said.getvalue().rstrip()}\n```"]
