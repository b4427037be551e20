"""The renderers that the configuration offers."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import yaml

from gausim.core import Renderer

CONFIGS = sorted((Path(__file__).parents[2] / "conf" / "render").glob("*.yaml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_config_builds_a_renderer(path: Path) -> None:
    options = yaml.safe_load(path.read_text())
    module, name = options.pop("_target_").rsplit(".", 1)
    renderer = getattr(importlib.import_module(module), name)(**options)
    assert isinstance(renderer, Renderer)
    assert {key: getattr(renderer, key) for key in options} == options


def test_there_are_configs() -> None:
    assert {path.stem for path in CONFIGS} >= {"cpu", "reference"}
