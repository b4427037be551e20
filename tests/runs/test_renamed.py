"""Runs of the version before are read by the names of this one."""

from __future__ import annotations

import importlib

import pytest
import yaml

from gausim.runs.directory import CONFIG, RunDirectory
from gausim.runs.renamed import MOVED


@pytest.mark.parametrize("new", sorted(MOVED.values()))
def test_every_new_name_exists(new: str) -> None:
    module, _, name = new.rpartition(".")
    if name[0].isupper() or name == "make_trainer":
        assert hasattr(importlib.import_module(module), name)
    else:
        importlib.import_module(new)


def test_a_configuration_of_before_is_read_by_present_names(tmp_path) -> None:
    old = {
        "model": {"simulator": {"_target_": "gausim.models.simulator.GausSim", "hidden": 8}},
        "callbacks": [{"_target_": "gausim.engine.callbacks.Progress"}, {"_target_": "torch.nn.Module"}],
    }
    (tmp_path / CONFIG).write_text(yaml.safe_dump(old))
    assert RunDirectory(tmp_path).config() == {
        "model": {"simulator": {"_target_": "gausim.models.step.simulator.GausSim", "hidden": 8}},
        "callbacks": [
            {"_target_": "gausim.training.callbacks.progress.Progress"},
            {"_target_": "torch.nn.Module"},
        ],
    }
