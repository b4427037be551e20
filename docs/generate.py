"""A hook of MkDocs: writes the references of the configuration (from conf/) and of the commands (from their --help)."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
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
from gausim.compose.root import conf_dir, options

# Files of these groups set keys of any other group: one table each, of what they set.
RECIPES = {"experiment": "Experiments", "ablation": "Ablations"}
GROUPS = ("model", "data", "supervision", "render", "trainer", "logger")
ROOT = Path(__file__).resolve().parents[1]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the generated pages to those of docs/."""
    for name, text in (("configuration", configuration()), ("commands", commands())):
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def configuration() -> str:
    """The page of all configuration groups, their files and their keys."""
    parts = [
        "# Configuration",
        "`gausim train KEY=VALUE …` sets keys, `GROUP=FILE` chooses a file of a group. An experiment chooses files of "
        "the other groups, an ablation comes after it, and what stands on the command line wins. This page is made "
        "from `conf/`; `gausim train --cfg job` prints the whole configuration.",
        "## Root keys",
        *_file("train.yaml"),
    ]
    for group in GROUPS:
        parts.append(f"## {group}")
        for name in options(group):
            parts += [f"### `{group}={name}`", *_file(f"{group}/{name}.yaml")]
    for group, title in RECIPES.items():
        rows = [_recipe(group, name) for name in options(group)]
        parts += [f"## {title}", *_table((f"`{group}=`", "what it does", "what it sets"), rows)]
    return "\n\n".join(parts)


def _file(name: str) -> Iterator[str]:
    """Head comment and table of one file's keys."""
    path = conf_dir() / name
    node, comments = yaml.safe_load(path.read_text()) or {}, _comments(path)
    yield _head(path)
    inherited = ", ".join(_begins_with(node))
    yield f"It begins with {inherited}." if inherited else ""
    rows = [(f"`{key}`", f"`{value}`", _cell(comments.get(key, ""))) for key, value in _flat(node)]
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


def _recipe(group: str, name: str) -> tuple[str, str, str]:
    path = conf_dir() / group / f"{name}.yaml"
    node = yaml.safe_load(path.read_text()) or {}
    sets = [*_begins_with(node), *(f"`{key}={value}`" for key, value in _flat(node))]
    return f"`{name}`", _cell(_head(path)), "<br>".join(sets)


def _begins_with(node: dict[str, Any]) -> list[str]:
    """Takes the defaults list out of a file: its entries as one would write them on the command line."""
    entries = [
        e if isinstance(e, dict) else {e: ""} for e in node.pop("defaults", []) if e not in ("_self_", "base_schema")
    ]
    pairs = [pair for entry in entries for pair in entry.items()]
    return [f"`{group.removeprefix('override ').lstrip('/')}{f'={name}' if name else ''}`" for group, name in pairs]


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
