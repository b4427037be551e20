"""Training of a run: from a configuration to a finished directory."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from lightning.pytorch import seed_everything
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf

from gausim.baselines import fitting
from gausim.baselines.fitting import FittedModule
from gausim.compose.build import Opened, build_module
from gausim.compose.config import instantiate
from gausim.core import ConfigError, RunError
from gausim.data.datamodule import ReadyDataModule
from gausim.data.idle import idle_sequences
from gausim.results.looks import TEST_PART
from gausim.runs.data_print import changed_files, write_prints
from gausim.runs.directory import RunDirectory
from gausim.training import run as simulation
from gausim.training.module import GausSimModule
from gausim.training.ranks.launch import joined
from gausim.training.ranks.ranks import Ranks
from gausim.training.trainer import TrainerSettings

log = logging.getLogger(__name__)

# Folders of loggers within the run.
FOLDERS: dict[str, dict[str, str]] = {
    "tensorboard": {"name": "tensorboard", "version": ""},
    "csv": {"name": "csv"},
}


def train(opened: Opened, run: RunDirectory, *, notes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Trains a configuration into a run directory that is locked by this process.

    Returns the facts that the finished run records, with further ``notes``; other ranks than the first return nothing.

    Raises:
        GausSimError: the run is finished, has another configuration or is damaged, or training diverged.
    """
    cfg, data = opened
    settings: TrainerSettings = instantiate(cfg.trainer)
    with joined(settings):
        first, config = is_first(), plain(cfg)
        if first or Ranks().size > 1:  # others that this process starts later find the directory prepared
            resume = Ranks().first(lambda: run.prepare(config, overwrite=cfg.overwrite))
        else:
            resume = run.checkpoint_to_resume
        seed_everything(cfg.seed, workers=True, verbose=False)
        check_protocol(cfg, data)
        if first or Ranks().size > 1:
            Ranks().first(lambda: _note_data(run, data, resumed=resume is not None))
        if "joint" in str(cfg.ablation.name).split("+") and len(data.objects) == 1:
            raise ConfigError(f"ablation=joint: expected several objects, the data have {data.objects[0].name} alone.")
        module = build_module(cfg, data)
        kind: Any = fitting if isinstance(module, FittedModule) else simulation
        kind.begin(module, data, config, resumed=resume is not None)
        wanted = (cfg.logger or {}).items() if first else ()
        loggers = [instantiate(n, save_dir=str(run.path), **FOLDERS.get(str(k), {})) for k, n in wanted if n]
        for logger in loggers:
            logger.log_hyperparams(config)
        if first:
            _introduce(run, module, data, settings, kind.course(module, data, config), resumed=resume is not None)
        try:
            facts: dict[str, Any] = kind.fit(
                module, data, settings, run.path, seed=int(cfg.seed), resume=resume, loggers=loggers
            )
        finally:
            run.has_stepped = module.global_step > 0
        if not first:
            return {}
        facts |= notes or {}
        run.finish(facts)
        return facts


def _note_data(run: RunDirectory, data: ReadyDataModule, *, resumed: bool) -> None:
    """Stores the fingerprints of a new run's data; a run that goes on has to find them as they were."""
    if not resumed:
        write_prints(run.path, data.objects)
        for text in idle_sequences(data.objects):
            log.warning("%s", text)
    elif changed := changed_files(run.path, data.objects):
        raise RunError(f"{changed} Restore them to resume the run, or set overwrite=true.")


def is_first() -> bool:
    """Whether this process is the rank that writes."""
    return not getattr(rank_zero_only, "rank", 0)


def plain(cfg: DictConfig) -> dict[str, Any]:
    """The whole configuration in plain containers."""
    return cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True))


def check_protocol(cfg: DictConfig, data: ReadyDataModule) -> None:
    """Raises ConfigError where the evaluation after training could not be made as the protocol demands."""
    part, trials = cfg.data.get("part"), cfg.trials
    if not cfg.evaluate:
        return
    names = [(item.test_part, record.name) for item in data.objects for record in item.sequences]
    reserved = [name in part_of for part_of, name in names]
    if part == TEST_PART and not trials:
        raise ConfigError(
            f"trials: expected the number of trials made on the development part before a test evaluation "
            f"(data.part=test), got {trials}."
        )
    if part != TEST_PART and all(reserved):
        raise ConfigError(
            "evaluate: all sequences of the data belong to the test part. Set data.part=test and trials=N (N made "
            "on the development part), or evaluate=false."
        )


def _introduce(
    run: RunDirectory, module: GausSimModule | FittedModule, data: ReadyDataModule, settings: TrainerSettings,
    lines: Sequence[str], *, resumed: bool,
) -> None:  # fmt: skip
    """Prints device, data, parameters and course of a training."""
    count = settings.threads or torch.get_num_threads()
    ranks = f"{settings.size} ranks, " if settings.size > 1 else ""
    threads = f"({ranks}{count} torch thread{'s' if count != 1 else ''})"
    print(f"{'resuming' if resumed else 'training'} on {'cuda' if settings.on_gpu else 'cpu'} {threads}: {run.path}")
    kernels = sum(scene.count for scene in module.scenes)
    pinned = sum(int(scene.pinned.sum()) for scene in module.scenes)
    print("".join(f"  {line}\n" for line in data.introduction()) + f"  {kernels} kernels ({pinned} pinned)")
    sizes = {name: sum(p.numel() for p in own) for name, own in module.groups().items()}
    print("  parameters: " + (", ".join(f"{name} {count}" for name, count in sizes.items()) or "none"))
    print("".join(f"  {line}\n" for line in lines), end="", flush=True)
