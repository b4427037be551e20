"""Setup of Hydra before composition: directory of conf/ and its files, schema of the root keys, and resolvers.

This module does not load torch, so that shell completion is fast.
"""

import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import MISSING, OmegaConf

import gausim
from gausim.core.errors import ConfigError

HYDRA_VERSION_BASE, ROOT_FILE = "1.3", "train"
LONGEST_FOLDER_NAME = 120


@dataclass
class RootConfig:
    """Schema of the root keys of a training configuration: a misspelt root key is an error."""

    data: Any = MISSING  # the data module: which set, views, frames and batches
    model: Any = MISSING  # the dynamics
    loss: Any = None  # the terms and their weights; null for a method that is fitted in stages
    optimizer: Any = None  # the optimiser and its rates; null for a method that is fitted in stages
    plan: Any = MISSING  # epochs, predicted frames, schedule, warm start and end
    supervision: Any = None  # reference of the predictions: images, true points or motion tracks
    render: Any = MISSING  # the renderer
    trainer: Any = MISSING  # devices, threads, checkpoints and display
    logger: Any = None  # loggers by name
    ablation: Any = None  # record of the chosen ablation
    seed: int = 0  # seed of every random generator
    # Name of the run, by default that of the data; its directory is `${output_root}/${name}/seed_${seed}`.
    name: str = MISSING
    output_root: str = "outputs"  # directory of all runs; a relative path starts at the directory of the command
    # Run from which the network and its input statistics are copied; null: random initialisation.
    init_from: str | None = None
    # `network` freezes that network, so that only parameters of scenes are trained; `model` copies the whole simulator
    # of that run and freezes it, so that only initial states are trained.
    freeze: str | None = None
    doctor: bool = True  # whether the findings of `gausim doctor` are printed before training (not in sweeps)
    evaluate: bool = False  # whether the run is evaluated after training (`gausim evaluate`), for reports
    # Trials that were made of the method on the development part, declared in every table of the test part.
    trials: int | None = None
    overwrite: bool = False  # remove an existing run in the directory
    retry_failed: bool = False  # in a sweep, resume runs that ended with an error; otherwise they are skipped


def folder_name(text: str, name: str = "") -> str:
    """Returns a directory name for a text: the text itself if valid, else a short form with a hash.

    Overrides `data=object,data.root=DIRECTORY` of a job become the directory's last part, if ``name`` is another.
    """
    parts = [part for part in text.split(",") if part != "data=object"]
    roots = [part for part in parts if part.startswith("data.root=")]
    if len(parts) < len(text.split(",")) and len(roots) == 1:
        path = roots[0].partition("=")[2].strip("'")
        short = f"{Path(path).name}-{hashlib.sha256(path.encode()).hexdigest()[:6]}"
        text = ",".join([*([] if Path(path).name == name else [short]), *(part for part in parts if part not in roots)])
    plain = re.sub(r"[^\w.,=+~:-]+", "_", text)
    if plain == text and len(text) <= LONGEST_FOLDER_NAME:
        return text
    return f"{plain[: LONGEST_FOLDER_NAME - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def in_sweep() -> bool:
    """Returns whether the running job is one of a sweep (`-m`)."""
    return bool(HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN)


def job_threads(most: int) -> int:
    """Returns the threads of one job: `most`, or fewer where a sweep divides the cores among parallel jobs."""
    if not in_sweep():
        return most
    launcher = HydraConfig.get().launcher
    if "cpus_per_task" in launcher:  # submitit: cores granted by the scheduler
        return min(most, int(launcher.cpus_per_task or 1))
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    jobs = int(launcher.get("n_jobs") or 1)  # joblib; -1: all cores, -2: all but one, ...
    return min(most, max(1, cores // (jobs if jobs > 0 else max(1, cores + 1 + jobs))))


def chosen(group: str) -> str:
    """Returns the choice of a group: `no_mass`, of a list `no_mass+no_momentum`, or `none`."""
    if not HydraConfig.initialized():
        return "none"  # composed without a job
    job = HydraConfig.get()
    choice = job.runtime.choices.get(group)
    if choice is None:  # Hydra does not record lists
        overrides = OverridesParser.create().parse_overrides(list(job.overrides.task))
        values = [override.value() for override in overrides if override.key_or_group == group]
        choice = "+".join(str(part) for value in values[-1:] if isinstance(value, list) for part in value)
    return str(choice or "none")


def data_name(*, _root_: Any) -> str:
    """Returns the default name of a run: the name of its data, of a directory that of the directory."""
    choice, root = chosen("data"), OmegaConf.select(_root_, "data.root")
    if choice in ("none", "object") and isinstance(root, str):
        return Path(root).resolve().name
    return choice.replace("/", "_")


def job_group(name: str) -> str:
    """Returns the group of a run on dashboards, NAME/ABLATION/MODEL, common to its seeds and settings."""
    return "/".join([name, chosen("ablation"), chosen("model")]) if HydraConfig.initialized() else name


def job_name(seed: int) -> str:
    """Returns the name of a run within its group on dashboards: its seed, in a sweep after its overrides."""
    overrides = folder_name(HydraConfig.get().job.override_dirname) if in_sweep() else ""
    return f"{overrides}/seed_{seed}" if overrides else f"seed_{seed}"


ConfigStore.instance().store(name="base_schema", node=RootConfig, provider="gausim")
for resolver in (chosen, data_name, folder_name, job_threads, job_group, job_name):
    OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)


def conf_dir() -> Path:
    """Returns the directory of the configurations: the copy in the wheel, or conf/ of the checkout.

    Raises:
        ConfigError: neither exists.
    """
    package = Path(gausim.__file__).resolve().parent
    candidates = (package / "conf", package.parents[1] / "conf")
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise ConfigError(
        f"expected the configurations in {candidates[0]} or {candidates[1]}, found neither. Reinstall gausim, or run "
        "from a complete checkout."
    )


def options(group: str, *more: Path) -> list[str]:
    """Returns the names of the files of a group in conf/, and in further directories like it: `tables/comparison`."""
    folders = [root / group for root in (conf_dir(), *more)]
    return sorted({path.relative_to(f).with_suffix("").as_posix() for f in folders for path in f.rglob("*.yaml")})
