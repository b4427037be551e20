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

from gausim.cli.main import COMMANDS
from gausim.compose.places import Place, read_places
from gausim.compose.root import RootConfig, conf_dir
from gausim.compose.schema import documented

ROOT = Path(__file__).resolve().parents[1]
# Files of these groups set keys of any other group: one table each, of what they set.
RECIPES = {"experiment": "Experiments", "ablation": "Ablations", "budget": "Budgets", "sweep": "Sweeps"}
GROUPS = ("data", "model", "supervision", "loss", "optimizer", "render", "trainer", "logger", "callbacks", "paths")
STAGES = ("prepare", "ingest", "poses", "compare_poses", "segment", "reconstruct", "select", "assemble", "pack",
          "import_ready", "synthesize", "blender_bunny")  # fmt: skip


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the generated pages to those of docs/."""
    pages = {"reference/configuration.md": configuration(), "reference/commands.md": commands()}
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def configuration() -> str:
    """The page of all configuration groups, their files and their keys."""
    places = read_places()
    root = [(f"`{key}`", _cell(said)) for key, said in documented(RootConfig).items() if key not in GROUPS]
    parts = [
        "# Configuration",
        "`gausim train KEY=VALUE …` sets keys, `GROUP=FILE` chooses a file of a group. An experiment may replace any "
        "group, an ablation comes after it, and single keys of the command line come last. This page is made from "
        "`conf/`; `gausim train --cfg job` prints the whole configuration with all overrides applied, "
        "`gausim config validate` checks one, and `gausim config schema` prints it for editors.",
        "## Root keys",
        *_table(("key", "meaning"), root),
    ]
    for group in GROUPS:
        parts.append(f"## {group}")
        for path in sorted((conf_dir() / group).glob("*.yaml")):
            parts += _file(path, places.children.get(group, Place()))
    for group, title in RECIPES.items():
        rows = [_recipe(path) for path in sorted((conf_dir() / group).glob("*.yaml"))]
        parts += [f"## {title}", *_table((f"`{group}=`", "what it does", "what it sets"), rows)]
    parts += ["## What the simulators have in common", *_file(conf_dir() / "base" / "simulator.yaml", places)]
    return "\n\n".join(parts)


def _file(path: Path, place: Place) -> Iterator[str]:
    """Title, head comment and table of one file's keys."""
    node = yaml.safe_load(path.read_text()) or {}
    chosen = "" if path.parent.name == "base" else f"{path.parent.name}="
    yield f"### `{chosen}{path.stem}`"
    yield _head(path)
    inherited = [e for e in node.pop("defaults", []) if e != "_self_"]
    if inherited:
        yield "It begins with " + ", ".join(f"`{_entry(e)}`" for e in inherited) + "."
    rows = [(f"`{key}`", f"`{value}`", _cell(_meaning(place, key))) for key, value in _flat(node)]
    if rows:
        yield from _table(("key", "value", "meaning"), rows)


def _recipe(path: Path) -> tuple[str, str, str]:
    node = yaml.safe_load(path.read_text()) or {}
    chosen = [_entry(e) for e in node.pop("defaults", []) if e != "_self_"]
    node.pop(path.parent.name, None)
    sets = [f"{key}={value}" for key, value in _flat(node)]
    return f"`{path.stem}`", _cell(_head(path)), "<br>".join(f"`{_cell(s)}`" for s in chosen + sets)


def _entry(entry: Any) -> str:
    """An entry of a defaults list as one would write it on the command line."""
    if isinstance(entry, str):
        return entry.lstrip("/")
    ((group, name),) = entry.items()
    return f"{group.removeprefix('override ').lstrip('/')}={name}"


def _head(path: Path) -> str:
    """The comment at the top of a file, or behind its `_target_`."""
    lines = path.read_text().splitlines()
    block = [re.sub(r"^# ?", "", line) for line in lines if line.startswith("#") and "@package" not in line]
    found = re.search(r"^_target_:.*?#\s*(.*)", path.read_text(), re.MULTILINE)
    return " ".join(line.strip() for line in block) or (found.group(1) if found else "")


def _flat(node: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in node.items():
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{prefix}{key}.")
        elif key not in ("_partial_", "_recursive_", "_convert_"):
            yield f"{prefix}{key}", _value(value)


def _value(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False).removesuffix("...\n").strip()
    return text.replace("|", "\\|")


def _meaning(place: Place, key: str) -> str:
    """What conf/ says of a key anywhere, else what the docstring of what is built says."""
    said, parts = "", key.split(".")
    for i, part in enumerate(parts):
        inner = place.children.get(part)
        if inner is None:
            return ""
        last = i == len(parts) - 1
        said = inner.comment or (next(filter(None, (_argument(t, part) for t in place.targets)), "") if last else "")
        place = inner
    return said


def _argument(target: str, name: str) -> str:
    module, _, attribute = target.rpartition(".")
    if not target.startswith("gausim."):
        return ""
    found = getattr(importlib.import_module(module), attribute)
    return {**documented(found), **documented(found.__init__)}.get(name, "")


def _cell(text: str) -> str:
    return re.sub(r"``(.+?)``", r"`\1`", text).replace("|", "\\|").replace("\n", " ")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return ["\n".join(f"| {' | '.join(row)} |" for row in lines)]


def commands() -> str:
    """The page of all commands: their own words."""
    os.environ["COLUMNS"] = "100"
    sys.path.insert(0, str(ROOT))
    parts = [
        "# Commands",
        "What `gausim COMMAND --help` prints, and behind it the stages of `data_prep`, which are run from a checkout. "
        "The exit status is 0 where a command worked, 2 on wrong usage or unusable input, 130 when interrupted. "
        "`GAUSIM_DEBUG=1` shows the traceback of an error.",
    ]
    for name, command in COMMANDS.items():
        parts += _help(f"gausim {name}", importlib.import_module(command.module).main)
    for name in STAGES:
        parts += _help(f"python -m data_prep.{name}", importlib.import_module(f"data_prep.{name}").main)
    return "\n\n".join(parts)


def _help(title: str, main: Callable[[list[str]], object]) -> list[str]:
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        main(["--help"])
    text = said.getvalue().rstrip()
    text = re.sub(r"^usage: \S+\.py", f"usage: {title}", text)
    return [f"## `{title}`", f"```text\n{text}\n```"]
