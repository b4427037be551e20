"""Modules that have moved since runs were made whose configurations name them; for one version."""

from __future__ import annotations

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
    "gausim.engine.run.make_trainer": "gausim.training.trainer.make_trainer",
    "gausim.engine.stages": "gausim.training.fitted.stages",
    "gausim.engine.tracks": "gausim.training.supervision.motion_tracks",
    "gausim.engine.wandb_log": "gausim.training.loggers.wandb",
    "gausim.models.elastic": "gausim.models.template.elastic",
    "gausim.models.material": "gausim.models.template.material",
    "gausim.models.simulator": "gausim.models.step.simulator",
}


def with_present_names(config: Any) -> Any:
    """A configuration whose `_target_`s are where they are now; what never moved stays as it is."""
    if isinstance(config, dict):
        return {k: _present(v) if k == "_target_" else with_present_names(v) for k, v in config.items()}
    return [with_present_names(v) for v in config] if isinstance(config, list) else config


def _present(target: Any) -> Any:
    for old, new in MOVED.items():
        if isinstance(target, str) and (target == old or target.startswith(f"{old}.")):
            return new + target[len(old) :]
    return target
