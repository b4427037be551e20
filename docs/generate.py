"""A hook of MkDocs: generates the references of configuration and commands, and all tables of the results.

Configurations come from ``conf/``, commands from their ``--help``, tables and downloads from ``docs/results/``.
"""

from __future__ import annotations

import contextlib
import csv
import importlib
import inspect
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
from mkdocs.structure.pages import Page
from msgspec.structs import astuple

from gausim.cli.main import COMMANDS, command
from gausim.cli.prepare import STAGES
from gausim.compose.root import conf_dir, options
from gausim.report.layouts import layout
from gausim.results.pivot import Pivot, markdown_table
from gausim.results.table import Entry, Results, load_results

# Files of these groups set keys of any other group: one table each, of what they set.
RECIPES = {"experiment": "Experiments", "ablation": "Ablations"}
GROUPS = ("model", "data", "supervision", "render", "trainer", "logger")
ROOT = Path(__file__).resolve().parents[1]
LIVE = ROOT / "outputs" / "demo" / "seed_0" / "page.html"  # of `make demo`


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the generated pages to those of docs/."""
    for name, text in (("configuration", configuration()), ("commands", commands())):
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    records = {path.stem: load_results(path) for path in sorted((ROOT / "docs" / "results").glob("*.json"))}
    files.append(File.generated(config, "results/details.md", content=details(records)))
    for name, record in records.items():
        files.append(File.generated(config, f"results/{name}.csv", content=csv_of(record)))
    if LIVE.is_file():
        files.append(File.generated(config, "live/demo.html", abs_src_path=str(LIVE)))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Puts the demo's page into the gallery, where `make demo` has made it."""
    if page.file.src_uri != "gallery.md" or not LIVE.is_file():
        return markdown
    style = "width: 100%; height: 640px; border: 0"
    frame = f'<iframe src="../live/demo.html" title="A learned flower" style="{style}"></iframe>'
    return re.sub(r"(?s)<!-- live -->.*?<!-- /live -->", frame, markdown)


def details(records: dict[str, Results]) -> str:
    """The page of all tables of all records, with commits and commands."""
    parts = [
        "# All tables",
        "Every record of [results](../results.md) with deviations, commits and commands. ± is the deviation over "
        "seeds, in brackets that over sequences. The commands are those of the commits that made the record.",
    ]
    for name, record in records.items():
        pivot, made = Pivot(record), record.made
        parts += [f"## {name}", f"{record.title}. Download: [CSV]({name}.csv), [JSON]({name}.json)."]
        if made:
            machine = "; ".join(made.hardware)
            parts += [made.test, f"Commits {', '.join(made.commits)}; recorded {made.recorded}; {machine}."]
        for thing, info in record.objects.items():
            kinds = ("comparison", "ahead", "ablations", "bounce", "motion") if info.splits else ("",)
            kinds += tuple(f"{split} {views}" for split in info.splits for views in ("points", "train", "heldout"))
            for kind in kinds:
                grid = layout(pivot, thing, kind)
                parts += [] if grid is None else [f"**{thing}** {kind}", markdown_table(grid)]
        if made and made.commands:
            parts.append("```text\n" + "\n".join(made.commands) + "\n```")
    return "\n\n".join(filter(None, parts))


def csv_of(record: Results) -> str:
    """The long table of a record: a line per figure and seed."""
    lines = io.StringIO()
    writer = csv.writer(lines)
    writer.writerow(Entry.__struct_fields__)
    writer.writerows(astuple(entry) for entry in record.table)
    return lines.getvalue()


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
    node, comments = yaml.safe_load(path.read_text()) or {}, _meanings(path)
    yield _head(path)
    inherited = ", ".join(_begins_with(node))
    yield f"It begins with {inherited}." if inherited else ""
    rows = []
    for key, value in _flat(node):  # a key without a meaning of its own has that of its node
        rows.append((f"`{key}`", f"`{value}`", _cell(comments.get(key) or comments.get(key.rpartition(".")[0], ""))))
    yield from _table(("key", "value", "meaning"), rows)


def _meanings(path: Path) -> dict[str, str]:
    """What the keys of a file mean, by their whole names.

    The comment behind a key, else that in the first of the files that this one begins with, else the documentation of
    the class. A later file's comment is on its own value.
    """
    return _defined(path) | {key: text for key, text in _comments(path).items() if text}


def _defined(path: Path) -> dict[str, str]:
    """Meanings of keys in the file that has them first."""
    node = yaml.safe_load(path.read_text()) or {}
    names = [entry.split("@")[0] for entry in node.get("defaults", []) if isinstance(entry, str)]
    bases = [(conf_dir() / name[1:] if name[0] == "/" else path.parent / name).with_suffix(".yaml") for name in names]
    found: dict[str, str] = {}
    for meanings in (*map(_defined, filter(Path.is_file, bases)), _comments(path), _documented(node)):
        found |= {key: text for key, text in meanings.items() if not found.get(key)}
    return found


def _documented(node: dict[str, Any], prefix: str = "") -> dict[str, str]:
    """What the documentation of the classes says of their arguments, by the keys' whole names."""
    found: dict[str, str] = {}
    for key, value in node.items():
        if key == "_target_":
            target = pkgutil.resolve_name(re.sub(r"\.(\w+)$", r":\1", value))
            texts, summary = _arguments(target), (inspect.getdoc(target) or "").split("\n\n")[0]
            found[f"{prefix}_target_"] = "builds: " + " ".join(summary.split()).rstrip(".")
            found |= {prefix + name: text for name, text in texts.items() if name in node}
        elif isinstance(value, dict):
            found |= _documented(value, f"{prefix}{key}.")
    return found


def _arguments(target: Any) -> dict[str, str]:
    """The arguments and attributes that a class or function documents, in Google's form, by name."""
    found: dict[str, str] = {}
    for owner in (target, getattr(target, "__init__", None)):
        doc = inspect.getdoc(owner) or ""
        for section in re.findall(r"(?ms)^(?:Args|Attributes|Options):\n((?:[ ]{4}.*\n?|\n)+)", doc):
            for name, text in re.findall(r"(?m)^ {4}(\w+): ((?:.*\n?)(?: {8}.*\n?)*)", section):
                found.setdefault(name, " ".join(text.split()).rstrip("."))
    return found


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
