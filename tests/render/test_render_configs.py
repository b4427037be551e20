"""The renderers that the configuration offers."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, cast

import pytest
from omegaconf import OmegaConf

import gausim.compose.root  # noqa: F401  (the resolvers that the files use)
from gausim.core import Renderer

CONFIGS = sorted((Path(__file__).parents[2] / "conf" / "render").glob("*.yaml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_config_builds_a_renderer(path: Path) -> None:
    options = cast(dict[str, Any], OmegaConf.to_container(OmegaConf.load(path), resolve=True))
    module, name = options.pop("_target_").rsplit(".", 1)
    renderer = getattr(importlib.import_module(module), name)(**options)
    assert isinstance(renderer, Renderer)
    assert {key: getattr(renderer, key) for key in options} == options


def test_there_are_configs() -> None:
    assert {path.stem for path in CONFIGS} >= {"cpu", "reference"}
