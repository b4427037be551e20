"""Every package that the sources import is declared in pyproject.toml and pinned in constraints.txt."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

# Users bring it themselves: it needs torchvision, which has to stay out of every environment of ours. The code that
# imports it says so where it is absent.
BROUGHT = ("sam2",)
# Runs in Blender's own environment, which the stage creates: these modules are Blender's.
IN_BLENDER = "blender_scene.py"
ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(
    path for folder in ("src", "data_prep") for path in (ROOT / folder).rglob("*.py") if path.name != IN_BLENDER
)


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield str(node.module).partition(".")[0]


def third_party() -> dict[str, Path]:
    found = {name: path for path in FILES for name in imported(path)}
    return {
        name: p for name, p in found.items() if name not in (*sys.stdlib_module_names, *BROUGHT, "gausim", "data_prep")
    }


@pytest.mark.parametrize("module", sorted(third_party()))
def test_import_is_declared_and_pinned(module: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    declared = {normal(re.split(r"[^\w.-]", line)[0]) for group in groups for line in group}
    pinned = {normal(line.split("==")[0]) for line in (ROOT / "constraints.txt").read_text().splitlines()}
    distributions = {normal(name) for name in packages_distributions().get(module, [module])}
    assert distributions & declared, f"{third_party()[module]}: {module} is of {distributions}, not in pyproject.toml"
    assert distributions & pinned, f"{third_party()[module]}: {module} is of {distributions}, not in constraints.txt"
