"""Runs of the version before are read by the names of this one."""

from __future__ import annotations

import pkgutil
from typing import Any

import pytest
import yaml
from helpers.toy_object import toy_scene

from gausim.compose.config import instantiate
from gausim.core import RunError
from gausim.losses.objective import EnergyLoss
from gausim.runs.directory import CONFIG, RunDirectory
from gausim.runs.renamed import ELASTIC, MOVED, with_present_names, with_present_weights
from gausim.training.trainer import TrainerSettings


def test_every_new_name_exists() -> None:
    assert all(pkgutil.resolve_name(new) is not None for new in MOVED.values())


OLD = {
    "model": {
        "simulator": {
            "_target_": "gausim.models.simulator.GausSim", "_partial_": True, "radii": [0.2, 0.5],
            "predicted_levels": [2, 1], "graph_radii": [2.0, 0.4], "hidden": 8, "lever_head": 0.1,
            "passive_frames": 4, "conserve_mass": False, "edge_bucket": 16,
        }
    },
    "loss": {
        "_target_": "gausim.losses.objective.Objective", "input_noise": 0.0, "static_weight": 2.0, "energy_weight": 3.0,
    },
    "optimizer": {"schedule": {"_target_": "gausim.engine.optim.CosineSchedule", "warmup": 0.02}},
    "trainer": {"_target_": "gausim.training.trainer.make_trainer", "max_epochs": 3, "devices": 2},
    "callbacks": [{"_target_": "gausim.engine.callbacks.Progress"}, {"_target_": "torch.nn.Module"}],
}  # fmt: skip


def test_a_configuration_of_before_is_read_by_present_names(tmp_path) -> None:
    (tmp_path / CONFIG).write_text(yaml.safe_dump(OLD))
    found = RunDirectory(tmp_path).config()
    assert [c["_target_"] for c in found["callbacks"]] == [
        "gausim.training.callbacks.progress.Progress", "torch.nn.Module",
    ]  # fmt: skip
    loss = instantiate(found["loss"])
    assert loss.static_weight == 2.0 and loss.energy == EnergyLoss(weight=3.0)
    assert found["optimizer"] == {"schedule": None}
    assert instantiate(found["trainer"]) == TrainerSettings(devices=2, max_epochs=3)
    simulator = found["model"]["simulator"]
    assert simulator["_target_"] == "gausim.models.step.simulator.GausSim" and simulator["conserve_mass"] is False
    assert simulator["hierarchy"]["levels"] == [
        {"diameter": 0.5, "edge_length": 2.0}, {"diameter": 0.2, "edge_length": 0.4},
    ]  # fmt: skip
    assert simulator["head"]["lever"] == 0.1 and simulator["rollout"]["energy_guard_frames"] == 4
    model = instantiate(simulator, scenes=[toy_scene()], fps=[24.0])()
    assert model.predicted_levels == (2, 1)
    assert with_present_names(found) == found


@pytest.mark.parametrize("wrong", [{"predicted_levels": [7, 1]}, {"graph_radii": [2.0]}, {"predicted_levels": 3}])
def test_levels_that_cannot_be_read_are_said(tmp_path, wrong) -> None:
    simulator = {**OLD["model"]["simulator"], **wrong}
    (tmp_path / CONFIG).write_text(yaml.safe_dump({"model": {"simulator": simulator}}))
    with pytest.raises(RunError, match=r"config\.yaml: model\.simulator"):
        RunDirectory(tmp_path).config()


def test_weights_of_before_are_read_by_present_names() -> None:
    old = {"model.network.decoder.0.weight": 1, "model.log_density.0": 2, "model.node_normaliser.mean": 3}
    assert with_present_weights(old) == {
        "model.predictor.network.decoder.0.weight": 1, "model.log_density.0": 2,
        "model.predictor.node_normaliser.mean": 3,
    }  # fmt: skip


MODAL = {"_target_": "gausim.models.initial_state.ModalInitialStates", "in_diagonals": True}
SOLID = {"_target_": "gausim.models.template.solid.SolidSettings", "spacing": 0.08}
MATERIAL = {"_target_": "gausim.models.template.material.MaterialTemplate", "modes": 48, "solid": SOLID}
OLD_ELASTIC = {
    "_target_": "gausim.models.elastic.ElasticTemplate",
    "modes": 8,
    "solid": 0.12,
    "hidden": 0,
    "damping": "full",
}
FILLING = {"_target_": "gausim.baselines.mpm.Filling", "dense": 2.0}
OLD_FILLING = {**FILLING, "ray_axis": 0, "open_side": None, "seed": 0}
IMAGE = {"_target_": "gausim.losses.image.ImageLoss", "window": 7}
FLOWS = {"_target_": "gausim.baselines.physgaussian.PhysGaussian", "material": "von_mises", "yield_stress": 1.0}
POINTS = {
    "_target_": "gausim.baselines.physdreamer.PhysDreamer", "particles": 8, "young_modulus": 1e5, "cells": 20,
    "density": 2000.0, "modulus_scale": 1.0, "filling": FILLING,
}  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (IMAGE | {"crop": True}, IMAGE),
        (MODAL, MODAL),
        (MODAL | {"modes": 27}, MODAL | {"vibrations": True}),
        (MODAL | {"modes": None}, MODAL | {"vibrations": False}),
        (MATERIAL, MATERIAL),
        (MATERIAL | {"free_modes": 2}, MATERIAL | {"solid": SOLID | {"free_modes": 2}}),
        (OLD_ELASTIC, {"_target_": ELASTIC, "modes": 8, "solid": 0.12}),
        (OLD_FILLING, FILLING),
    ],
)
def test_settings_that_moved_changed_or_went_are_read(old: dict[str, Any], new: dict[str, Any]) -> None:
    assert with_present_names(old) == new and with_present_names(new) == new


@pytest.mark.parametrize(
    ("old", "said"),
    [
        (OLD_ELASTIC | {"damping": "rayleigh"}, "template.damping is"),
        (OLD_ELASTIC | {"hidden": 64}, "template.hidden is"),
        (OLD_ELASTIC | {"solid": None}, "template.solid is"),
        (OLD_FILLING | {"ray_axis": 2}, "ray_axis is 2, which is no longer supported"),
        (FLOWS, "no longer supported"),
        (POINTS | {"gradients": False}, "gradients is False, which is no longer supported"),
    ],
)
def test_settings_that_were_used_and_are_gone_are_refused(old: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        with_present_names(old)


def test_the_settings_of_material_points_are_in_groups() -> None:
    new = with_present_names(POINTS)
    assert set(new) == {"_target_", "particles", "material", "discretisation", "modulus"}
    assert new["material"] == {"_target_": "gausim.baselines.mpm.Material", "young_modulus": 1e5, "density": 2000.0}
    assert new["discretisation"]["cells"] == 20 and new["discretisation"]["filling"] == FILLING
    assert new["modulus"]["scale"] == 1.0
    assert with_present_names(new) == new == with_present_names({**new, "gradients": True})
    assert "yield_stress" not in with_present_names({**FLOWS, "material": "fixed_corotated"})
