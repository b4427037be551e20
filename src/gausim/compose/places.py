"""Keys of all files of conf/, with their targets and comments."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from gausim.compose.root import conf_dir

ROOT_FILE, GLOBAL_PACKAGE = "train", "# @package _global_"
# Settings renamed since the last version.
RENAMED = {"trainer.overwrite": "overwrite"}
# Not settings: the defaults list, and the node `hydra`, which belongs to Hydra.
_NOT_OURS = ("defaults", "hydra")
BASE = "base"  # files that others include; not a group of choices
MORE = f"{BASE}/more.yaml"  # settings that no configuration lists, with the defaults of their constructors


@dataclass
class Place:
    """One key of the configuration, over all files that set it."""

    targets: list[str] = field(default_factory=list)  # the targets that any file builds there
    children: dict[str, Place] = field(default_factory=dict)  # the keys below
    comment: str = ""  # comment behind the key, from the first file that has one

    def merged(self) -> Place:
        """All children merged to one, for mappings with arbitrary names."""
        whole = Place()
        for child in self.children.values():
            whole.take(child)
        return whole

    def take(self, other: Place) -> None:
        """Adds the targets, children and comment of another place."""
        self.targets += [target for target in other.targets if target not in self.targets]
        self.comment = self.comment or other.comment
        for name, child in other.children.items():
            self.children.setdefault(name, Place()).take(child)


def choices() -> dict[str, list[str]]:
    """The groups of conf/ and the names of their files, e.g. `{"model": ["gausim", ...], "hydra/sweeper": [...]}`."""
    found: dict[str, list[str]] = {}
    for path in sorted(conf_dir().rglob("*.yaml")):
        if path.parent != conf_dir() and path.parent.name != BASE:
            group, name = option_of(path)
            found.setdefault(group, []).append(name)
    return found


def option_of(path: Path) -> tuple[str, str]:
    """Group and name of a file in conf/: (experiment, tables/comparison); below hydra/ every folder is a group."""
    *folders, name = path.relative_to(conf_dir()).with_suffix("").parts
    depth = len(folders) if folders[:1] == ["hydra"] else 1
    return "/".join(folders[:depth]), "/".join([*folders[depth:], name])


def read_places() -> Place:
    """The root place of conf/."""
    root = Place()
    for path in sorted(conf_dir().rglob("*.yaml")):
        text = path.read_text()
        folder = path.parent.relative_to(conf_dir()).parts
        is_global = not folder or GLOBAL_PACKAGE in text.splitlines()
        if not is_global and folder[0] in _NOT_OURS:
            continue
        place = root if is_global else root.children.setdefault(folder[0], Place())
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        if isinstance(node, yaml.MappingNode):
            _read(node, place, text.splitlines())
    return root


def more_settings() -> dict[str, Any]:
    """Settings that no composed configuration lists, by their dotted keys, with the defaults of their constructors."""
    return dict(_leaves(yaml.safe_load((conf_dir() / MORE).read_text()), ""))


def spelled(overrides: Sequence[str]) -> list[str]:
    """Converts overrides to Hydra's syntax: unlisted settings are added with ++, old names are replaced."""
    more, found = more_settings(), []
    for override in overrides:
        key, equals, value = override.partition("=")
        if key.lstrip("+") in RENAMED:
            new = RENAMED[key.lstrip("+")]
            print(f"{key} is called {new} now; the old name goes with the next version.", file=sys.stderr)
            key = new
        found.append(f"++{key}{equals}{value}" if key in more else f"{key}{equals}{value}")
    return found


def _leaves(node: Any, key: str) -> Iterator[tuple[str, Any]]:
    if not isinstance(node, dict):
        yield key, node
        return
    for name, child in node.items():
        yield from _leaves(child, f"{key}.{name}" if key else name)


def _read(node: yaml.MappingNode, place: Place, lines: list[str]) -> None:
    for key, value in node.value:
        if key.value == "_target_":
            place.take(Place([value.value]))
        elif key.value not in _NOT_OURS and not key.value.startswith("_"):
            child = place.children.setdefault(key.value, Place())
            child.comment = child.comment or _comment(key, value, lines)
            if isinstance(value, yaml.MappingNode):
                _read(value, child, lines)


def _comment(key: yaml.Node, value: yaml.Node, lines: list[str]) -> str:
    """The comment behind a value of one line, or behind the key of a longer value."""
    end = value.end_mark if value.end_mark.line == key.start_mark.line else key.end_mark
    found = re.match(r":?\s*#\s*(.*)", lines[end.line][end.column :])
    return found.group(1).strip() if found else ""
