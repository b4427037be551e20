"""Renamed modules, settings and weights, so that runs of the previous version can be read. Kept for one version."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

MOVED = {
    "gausim.baselines.physdreamer": "gausim.baselines.material_point.physdreamer",
    "gausim.baselines.physgaussian": "gausim.baselines.material_point.physgaussian",
    "gausim.baselines.spring_mass": "gausim.baselines.spring_gaus.spring_mass",
    "gausim.engine.callbacks.EpochSummary": "gausim.training.callbacks.progress.EpochSummary",
    "gausim.engine.callbacks.ExactResume": "gausim.training.callbacks.resume.ExactResume",
    "gausim.engine.callbacks.Progress": "gausim.training.callbacks.progress.Progress",
    "gausim.engine.callbacks.RunCheckpoint": "gausim.training.callbacks.resume.RunCheckpoint",
    "gausim.engine.callbacks.TimeBudget": "gausim.training.callbacks.time_budget.TimeBudget",
    "gausim.engine.convergence": "gausim.training.callbacks.convergence",
    "gausim.engine.loggers": "gausim.training.loggers.files",
    "gausim.engine.mlflow_log": "gausim.training.loggers.mlflow",
    "gausim.engine.motion_watch": "gausim.training.callbacks.motion_watch",
    "gausim.engine.optim": "gausim.training.optimizers",
    "gausim.engine.panels": "gausim.training.callbacks.panels",
    "gausim.engine.points": "gausim.training.supervision.points",
    "gausim.engine.run.make_trainer": "gausim.training.trainer.TrainerSettings",
    "gausim.engine.stages": "gausim.training.fitted.stages",
    "gausim.engine.tracks": "gausim.training.supervision.motion_tracks",
    "gausim.engine.wandb_log": "gausim.training.loggers.wandb",
    "gausim.models.elastic": "gausim.models.template.elastic",
    "gausim.models.material": "gausim.models.template.material",
    "gausim.models.simulator": "gausim.models.step.simulator",
    "gausim.training.supervision.motion_tracks.tracks_or_images": (
        "gausim.training.supervision.motion_tracks.TrackSupervision"
    ),
    "gausim.training.trainer.make_trainer": "gausim.training.trainer.TrainerSettings",
}
# Removed settings by class, which did not affect training or were off by default.
GONE = {
    "ImageLoss": ("crop",),
    "HierarchySettings": ("edge_bucket",),
    "make_trainer": ("overwrite",),
    "TrainerSettings": ("overwrite",),
    "TrackSupervision": ("rate",),
}
# New settings of old ones by class: old name, new name (in a group, after a dot), and what makes the new value.
CHANGED: dict[str, tuple[str, str, Callable[[Any], Any]]] = {
    "ModalInitialStates": ("modes", "vibrations", bool),
    "MaterialTemplate": ("free_modes", "solid.free_modes", int),
}
# No schedule now means a constant rate; a run with the cosine schedule can be evaluated, but not resumed.
SCHEDULES = ("ConstantSchedule", "CosineSchedule")
# Removed settings of which one value is still supported; a false value stands for all false values.
UNSUPPORTED: dict[str, dict[str, Any]] = {
    "Objective": {"input_noise": None},
    "MaterialTemplate": {"named_attributes": True, "exact_periods": None},
    "Filling": {"ray_axis": None, "open_side": None, "seed": None},
    **dict.fromkeys(("PointSupervision", "TrackSupervision"), {"velocity_weight": None}),
    "ModulusField": {"parametrisation": "log"},
    "PhysDreamer": {"gradients": True, "parametrisation": "log"},
    **dict.fromkeys(("SpringMass", "ConstantVelocity"), {"gradients": True}),
}
IMAGES = "gausim.training.supervision.images.training_views"
# Removed settings of the elastic template with the supported value of each.
ELASTIC = "gausim.models.template.elastic.ElasticTemplate"
SETTLED: dict[str, Any] = {"damping": "full", "inertia": "trained", "hidden": 0}
SIMULATOR = "gausim.models.step.simulator.GausSim"
Group = tuple[str, dict[str, str]]


def _group(target: str, *kept: str, **renamed: str) -> Group:
    """The class of a group, and its settings by their old names."""
    return target, {**{name: name for name in kept}, **renamed}


_MATERIAL = _group("gausim.baselines.mpm.Material", "young_modulus", "poisson_ratio", "density")
_GRID = _group(
    "gausim.baselines.material_point.method.Discretisation", "cells", "damping", "substeps", "courant", "filling"
)
# Settings that are now in groups, by class.
GROUPS: dict[str, dict[str, Group]] = {
    "gausim.baselines.material_point.physdreamer.PhysDreamer": {
        "material": _MATERIAL,
        "discretisation": _GRID,
        "modulus": _group(
            "gausim.baselines.material_point.physdreamer.ModulusField",
            modulus_scale="scale", modulus_resolution="resolution",
        ),
    },
    "gausim.baselines.material_point.physgaussian.PhysGaussian": {"material": _MATERIAL, "discretisation": _GRID},
    "gausim.models.template.material.MaterialTemplate": {
        "solid": _group("gausim.models.template.solid.SolidSettings", "spacing"),
    },
    "gausim.losses.objective.Objective": {
        "energy": _group(
            "gausim.losses.objective.EnergyLoss", energy_weight="weight", energy_frames="frames",
            energy_stretch="stretch", energy_probability="probability",
        ),
    },
    SIMULATOR: {
        "hierarchy": _group(
            "gausim.models.settings.HierarchySettings", "clustering", "max_neighbours", "edges", "body_frame",
            share_levels="share_network",
        ),
        "features": _group(
            "gausim.models.step.features.FeatureOptions", "angle", "rest_inputs", "coarse_inputs", "attributes",
            "gravity", "normaliser_floor", velocity_inputs="velocities",
        ),
        "network": _group(
            "gausim.nn.meshgraphnet.MeshGraphNet", "hidden", "layers", "norm", "activation", "precision", "checkpoint",
            "compile",
        ),
        "head": _group(
            "gausim.models.step.head.Head", "output_scale", "zero_output", "anchor", lever_head="lever"
        ),
        "rollout": _group(
            "gausim.models.settings.RolloutSettings", "cuda_graph", passive_frames="energy_guard_frames"
        ),
    },
}  # fmt: skip
# Old prefixes of the weights of the predictor within the model.
WEIGHTS = ("network.", "node_normaliser.", "edge_normaliser.")


def with_present_names(config: Any) -> Any:
    """Translates a configuration to the current names.

    Raises:
        IndexError, TypeError, ValueError: levels are malformed, or a setting is no longer supported.
    """
    if isinstance(config, dict):
        name = str(config.get("_target_")).rsplit(".", 1)[-1]
        if name in SCHEDULES:
            return None
        unsupported = UNSUPPORTED.get(name, {})
        wanted = [k for k, left in unsupported.items() if (config.get(k, left) or None) != left]
        if wanted:
            raise ValueError(f"{wanted[0]} is {config[wanted[0]]!r}, which is no longer supported: train the run again")
        if name in CHANGED and CHANGED[name][0] in config:
            old, new, made = CHANGED[name]
            (group, _, key), value = new.rpartition("."), made(config[old])
            config = {**config, **({group: {**config[group], key: value}} if group else {key: value})}
            del config[old]
        gone = (*GONE.get(name, ()), *unsupported)
        found = {
            k: _present(v) if k == "_target_" else with_present_names(v) for k, v in config.items() if k not in gone
        }
        if found.get("supervision") == {}:
            found["supervision"] = {"_target_": IMAGES, "_partial_": True}
        if found.get("_target_") == ELASTIC:
            return _settled(found)
        groups = GROUPS.get(str(found.get("_target_")), {})
        return _grouped(found) if groups and not any(isinstance(found.get(k), dict) for k in groups) else found
    return [with_present_names(v) for v in config] if isinstance(config, list) else config


def _present(target: Any) -> Any:
    for old, new in MOVED.items():
        if isinstance(target, str) and (target == old or target.startswith(f"{old}.")):
            return new + target[len(old) :]
    return target


def _settled(old: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of the elastic template without the removed ones."""
    for name, value in {**SETTLED, "solid": old.get("solid", 0.12), "geometric": old.get("geometric", 1.0)}.items():
        if old.get(name, value) != value or value is None:
            raise ValueError(f"template.{name} is {old.get(name)!r}, which is no longer supported: train the run again")
    return {name: value for name, value in old.items() if name not in SETTLED}


def _grouped(old: Mapping[str, Any]) -> dict[str, Any]:
    """Settings in their groups; missing ones get their former defaults. Plasticity was removed."""
    target = old["_target_"]
    if old.get("material", "fixed_corotated") != "fixed_corotated":
        raise ValueError(f"method.material is {old['material']!r}, which is no longer supported: fit the run again")
    gone = {"material", "yield_stress", "edge_bucket", "radii", "predicted_levels", "graph_radii"}
    gone |= {name for _, names in GROUPS[target].values() for name in names}
    new = {name: value for name, value in old.items() if name not in gone}
    for group, (kind, names) in GROUPS[target].items():
        new[group] = {"_target_": kind, **{names[k]: old[k] for k in names if k in old}}
    if target == SIMULATOR:
        new["network"]["_partial_"] = True
        diameters, lengths = (0.0, *old.get("radii", (0.1, 0.35))), old.get("graph_radii", (2.0, 0.4))
        predicted = zip(old.get("predicted_levels", (2, 1)), lengths, strict=True)
        new["hierarchy"]["levels"] = [
            {"diameter": diameters[level], "edge_length": length} for level, length in predicted
        ]
    return new


def with_present_weights(weights: Mapping[str, Any]) -> dict[str, Any]:
    """Translates the names of weights to the current ones."""
    old = tuple(f"model.{name}" for name in WEIGHTS)
    return {
        f"model.predictor.{name.removeprefix('model.')}" if name.startswith(old) else name: value
        for name, value in weights.items()
    }
