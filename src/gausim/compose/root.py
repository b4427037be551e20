"""What Hydra has to know before it composes: where conf/ lies, its root keys, the functions its values may call.

Nothing here loads torch, so that completions come at once.
"""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import MISSING, OmegaConf

import gausim

HYDRA_VERSION_BASE = "1.3"
LONGEST_FOLDER_NAME = 120


@dataclass
class SweepConfig:
    """What the jobs of a sweep do about runs that are there already.

    Attributes:
        retry_failed: train those again that an error ended; otherwise they are left out.
    """

    retry_failed: bool = False


@dataclass
class RootConfig:
    """Schema of the root keys of a training configuration: a misspelt root key fails instead of being ignored.

    Attributes:
        data: the data module: which set, views, frames and batches.
        model: the dynamics.
        supervision: what predictions are compared with; the images unless it names something else.
        loss: the terms and their weights.
        optimizer: the optimiser (partial, it awaits the parameters) and its schedule.
        render: the renderer.
        trainer: arguments of the Lightning trainer.
        logger: loggers by name.
        callbacks: callbacks by name.
        paths: where data is read and runs are written.
        ablation: what the chosen ablation records about itself.
        experiment: what the chosen experiment records about itself.
        sweep: what the jobs of a sweep do about runs that are there already.
        seed: of every random generator.
        init_from: run whose network, with the statistics of its inputs, this one starts from; null starts anew.
        freeze: `network` keeps that network as it is, so that only what a scene has of its own is learned; `model`
            takes all of the simulator from that run and keeps it, so that only initial states are learned.
        doctor: whether what `gausim doctor` would find wrong with the data is told before training (not in sweeps).
        evaluate: whether the run is evaluated once it is trained (`gausim evaluate`), for reports.
        overwrite: remove the run that the directory holds already.
        name: of the run; its directory is `${paths.output_root}/${name}/seed_${seed}`.
        task_name: what is being done, for logs and dashboards.
    """

    data: Any = MISSING
    model: Any = MISSING
    supervision: Any = None
    loss: Any = MISSING
    optimizer: Any = MISSING
    render: Any = MISSING
    trainer: Any = MISSING
    logger: Any = None
    callbacks: Any = None
    paths: Any = MISSING
    ablation: Any = None
    experiment: Any = None
    sweep: SweepConfig = field(default_factory=SweepConfig)
    seed: int = 0
    init_from: str | None = None
    freeze: str | None = None
    doctor: bool = True
    evaluate: bool = False
    overwrite: bool = False
    name: str = MISSING
    task_name: str = "train"


def folder_name(text: str) -> str:
    """Returns a text as the name of one directory: the same if it can be, else legible, short and with a hash."""
    text = re.sub(r"(^|,)\+\+", r"\1", text)
    plain = re.sub(r"[^\w.,=+~:-]+", "_", text)
    if plain == text and len(text) <= LONGEST_FOLDER_NAME:
        return text
    return f"{plain[: LONGEST_FOLDER_NAME - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def job_threads(most: int) -> int:
    """Returns the threads of one job: `most`, or its share of the cores where a sweep runs several at a time."""
    if not HydraConfig.initialized() or HydraConfig.get().mode != RunMode.MULTIRUN:
        return most
    launcher = HydraConfig.get().launcher
    if "cpus_per_task" in launcher:  # submitit: what the scheduler grants
        return min(most, int(launcher.cpus_per_task or 1))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jobs = int(launcher.get("n_jobs") or 1)  # joblib; negative: all cores but so many
    return min(most, max(1, cores // (jobs if jobs > 0 else max(1, cores + 1 + jobs))))


def chosen(group: str) -> str:
    """Returns what was chosen of a group: `no_mass`, of a list all of it, as `no_mass+no_momentum`, or `none`."""
    if not HydraConfig.initialized():
        return "none"  # composed without a job
    job = HydraConfig.get()
    choice = job.runtime.choices.get(group)
    if choice is None:  # Hydra does not record lists
        overrides = OverridesParser.create().parse_overrides(list(job.overrides.task))
        values = [override.value() for override in overrides if override.key_or_group == group]
        choice = "+".join(str(part) for value in values[-1:] if isinstance(value, list) for part in value)
    return str(choice or "none")


def job_group(name: str) -> str:
    """Returns what dashboards list a run under: NAME/ABLATION/MODEL, of which seeds and settings are variants."""
    return "/".join([name, chosen("ablation"), chosen("model")]) if HydraConfig.initialized() else name


def job_name(seed: int) -> str:
    """Returns what dashboards call a run within its group: of a sweep, its overrides and its seed."""
    hydra_config = HydraConfig.get() if HydraConfig.initialized() else None
    sweeps = hydra_config is not None and hydra_config.mode == RunMode.MULTIRUN
    overrides = folder_name(hydra_config.job.override_dirname) if hydra_config is not None and sweeps else ""
    return "/".join([*([overrides] if overrides else []), f"seed_{seed}"])


ConfigStore.instance().store(name="base_schema", node=RootConfig, provider="gausim")
for resolver in (chosen, folder_name, job_threads, job_group, job_name):
    OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)


def conf_dir() -> Path:
    """Returns the directory of the configurations: the wheel's own copy, or conf/ of the checkout.

    Raises:
        ConfigError: neither is there.
    """
    package = Path(gausim.__file__).resolve().parent
    candidates = (package / "conf", package.parents[1] / "conf")
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    from gausim.core.errors import ConfigError  # loads torch, which a completion must not wait for

    raise ConfigError(
        f"expected the configurations in {candidates[0]} or {candidates[1]}, found neither. Reinstall gausim, or run "
        "from a complete checkout."
    )
