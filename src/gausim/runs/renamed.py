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
SIMULATOR = "gausim.models.step.simulator.GausSim"
# New groups of the arguments of the simulator: class, and new name by old name.
PARTS: dict[str, tuple[str, dict[str, str]]] = {
    "hierarchy": (
        "gausim.models.settings.HierarchySettings",
        {
            "clustering": "clustering", "max_neighbours": "max_neighbours", "edges": "edges",
            "share_levels": "share_network", "body_frame": "body_frame",
        },
    ),
    "features": (
        "gausim.models.step.features.FeatureOptions",
        {
            "angle": "angle", "rest_inputs": "rest_inputs", "coarse_inputs": "coarse_inputs",
            "velocity_inputs": "velocities", "attributes": "attributes", "gravity": "gravity",
            "normaliser_floor": "normaliser_floor",
        },
    ),
    "network": (
        "gausim.nn.meshgraphnet.MeshGraphNet",
        {k: k for k in ("hidden", "layers", "norm", "activation", "precision", "checkpoint", "compile")},
    ),
    "head": (
        "gausim.models.step.head.Head",
        {"output_scale": "output_scale", "zero_output": "zero_output", "lever_head": "lever", "anchor": "anchor"},
    ),
    "rollout": (
        "gausim.models.settings.RolloutSettings",
        {"cuda_graph": "cuda_graph", "passive_frames": "energy_guard_frames"},
    ),
}  # fmt: skip
# Removed settings of the elastic template with the supported value of each.
ELASTIC = "gausim.models.template.elastic.ElasticTemplate"
SETTLED: dict[str, Any] = {"damping": "full", "inertia": "trained", "hidden": 0}
# Settings that are now in groups; the plasticity of the material point method was removed.
_MATERIAL = ("gausim.baselines.mpm.Material", ("young_modulus", "poisson_ratio", "density"))
_GRID = (
    "gausim.baselines.material_point.method.Discretisation", ("cells", "damping", "substeps", "courant", "filling"),
)  # fmt: skip
GROUPS: dict[str, dict[str, tuple[str, tuple[str, ...]]]] = {
    "gausim.baselines.material_point.physdreamer.PhysDreamer": {
        "material": _MATERIAL,
        "discretisation": _GRID,
        "modulus": (
            "gausim.baselines.material_point.physdreamer.ModulusField",
            ("modulus_scale", "modulus_resolution"),
        ),
    },
    "gausim.baselines.material_point.physgaussian.PhysGaussian": {"material": _MATERIAL, "discretisation": _GRID},
    "gausim.models.template.material.MaterialTemplate": {
        "solid": ("gausim.models.template.solid.SolidSettings", ("spacing",)),
    },
    "gausim.losses.objective.Objective": {
        "energy": (
            "gausim.losses.objective.EnergyLoss",
            ("energy_weight", "energy_frames", "energy_stretch", "energy_probability"),
        ),
    },
}
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
        groups = GROUPS.get(str(found.get("_target_")))
        if groups is not None and not any(isinstance(found.get(group), dict) for group in groups):
            return _grouped(found)
        return _in_parts(found) if found.get("_target_") == SIMULATOR and "hierarchy" not in found else found
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
    """Settings in their groups."""
    groups = GROUPS[old["_target_"]]
    if old.get("material", "fixed_corotated") != "fixed_corotated":
        raise ValueError(f"method.material is {old['material']!r}, which is no longer supported: fit the run again")
    gone = {"material", "yield_stress", *(name for _, names in groups.values() for name in names)}
    new = {name: value for name, value in old.items() if name not in gone}
    for group, (target, names) in groups.items():
        own = {name.removeprefix(f"{group}_"): old[name] for name in names if name in old}
        new[group] = {"_target_": target, **own}
    return new


def _in_parts(old: Mapping[str, Any]) -> dict[str, Any]:
    """The simulator's arguments in their groups; missing arguments get their former defaults."""
    moved = {name for _, names in PARTS.values() for name in names}
    gone = {"edge_bucket", "radii", "predicted_levels", "graph_radii", *moved}
    new = {name: value for name, value in old.items() if name not in gone}
    for part, (target, names) in PARTS.items():
        new[part] = {"_target_": target, **{names[k]: old[k] for k in names if k in old}}
    new["network"]["_partial_"] = True
    diameters, lengths = (0.0, *old.get("radii", (0.1, 0.35))), old.get("graph_radii", (2.0, 0.4))
    predicted = old.get("predicted_levels", (2, 1))
    new["hierarchy"]["levels"] = [
        {"diameter": diameters[level], "edge_length": length} for level, length in zip(predicted, lengths, strict=True)
    ]
    return new


def with_present_weights(weights: Mapping[str, Any]) -> dict[str, Any]:
    """Translates the names of weights to the current ones."""
    old = tuple(f"model.{name}" for name in WEIGHTS)
    return {
        f"model.predictor.{name.removeprefix('model.')}" if name.startswith(old) else name: value
        for name, value in weights.items()
    }
