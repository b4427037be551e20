"""Training of a run: from a configuration to a finished directory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf

from gausim.baselines.fitting import FittedModule, fit
from gausim.compose.build import CORPUS, build, load_run
from gausim.compose.config import instantiate
from gausim.core import ConfigError, TakesOver
from gausim.data.datamodule import ReadyDataModule
from gausim.data.pretraining import CorpusDataModule
from gausim.models.step.simulator import GausSim
from gausim.models.template.material import MaterialTemplate
from gausim.results.looks import TEST_PART
from gausim.runs.directory import RunDirectory
from gausim.runs.names import EPOCHS
from gausim.training.first_frames import begin_free_bodies
from gausim.training.material_scan import find_materials
from gausim.training.module import GausSimModule
from gausim.training.ranks.launch import joined
from gausim.training.ranks.ranks import Ranks
from gausim.training.table import Table
from gausim.training.trainer import TrainerSettings, make_trainer
from gausim.training.transfer import load_shared, load_simulator, unlike

# Largest first displacement per frame observed for small pushes [diagonals].
FIRST_STEP = 0.065

# Folders of loggers within the run.
FOLDERS: dict[str, dict[str, str]] = {
    "tensorboard": {"name": "tensorboard", "version": ""},
    "csv": {"name": "csv"},
}

COMPARED = {
    "ImageSupervision": "the images (supervision=images)",
    "TrackSupervision": "motion tracked in the images (supervision=tracks), each frame when it is first shown",
    "PointSupervision": "true points (supervision=points)",
}


def train(cfg: DictConfig, run: RunDirectory) -> dict[str, Any]:
    """Trains a configuration with a resolved plan into a run directory that is locked by this process.

    Returns the facts that the finished run records; other ranks than the first return nothing.

    Raises:
        GausSimError: the run is finished, has another configuration or is damaged, or training diverged.
    """
    settings: TrainerSettings = instantiate(cfg.trainer)
    with run.recording_failure(), joined(settings):
        first, config = is_first(), plain(cfg)
        if first or Ranks().size > 1:  # others that this process starts later find the directory prepared
            resume = Ranks().first(lambda: run.prepare(config, overwrite=cfg.overwrite))
        else:
            resume = run.checkpoint_to_resume
        seed_everything(cfg.seed, workers=True, verbose=False)
        module, datamodule = build(cfg)
        check_protocol(cfg, datamodule)
        if "joint" in str(cfg.ablation.name).split("+") and len(datamodule.objects) == 1:
            raise ConfigError(
                f"ablation=joint: expected several objects, the data have {datamodule.objects[0].name} alone."
            )
        if isinstance(module, FittedModule):
            facts = _fit(cfg, run, module, datamodule, resume, settings)
        else:
            _begin(cfg, module, datamodule, resumed=resume is not None)
            facts = _train(cfg, run, module, datamodule, resume, settings)
        if first:
            run.finish(facts)
        return facts


def is_first() -> bool:
    """Whether this process is the rank that writes."""
    return not getattr(rank_zero_only, "rank", 0)


def plain(cfg: DictConfig) -> dict[str, Any]:
    """The whole configuration in plain containers."""
    return cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True))


def check_protocol(cfg: DictConfig, datamodule: ReadyDataModule) -> None:
    """Raises ConfigError where the evaluation after training could not be made as the protocol demands."""
    part, trials = cfg.data.get("part"), cfg.trials
    if not cfg.evaluate or not datamodule.has_videos:
        return
    names = [(item.test_part, record.name) for item in datamodule.objects for record in item.sequences]
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


# ------------------------------------------------------------------------------------------------ fitted methods


def _fit(
    cfg: DictConfig, run: RunDirectory, module: FittedModule, datamodule: ReadyDataModule, resume: Path | None,
    settings: TrainerSettings,
) -> dict[str, Any]:  # fmt: skip
    """Fits a method stage by stage, on one rank."""
    if settings.size != 1:
        raise ConfigError(f"trainer.devices: {module.method_name} is fitted by one rank; expected 1.")
    _take_over(cfg, module, resumed=resume is not None)
    device = torch.device("cuda" if settings.on_gpu else "cpu")
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    lines = [f"{name}: {stage.iterations} iterations per sequence" for name, stage in module.plan.order]
    lines += [f"note: {note}" for note in module.model.notes()]
    _introduce(run, module, datamodule, str(device), lines, resumed=resume is not None)
    plan = cast(Any, datamodule.plan)
    try:
        return fit(module.to(device), datamodule, plan, run.path, seed=int(cfg.seed), resume=resume)
    finally:
        run.has_stepped = run.has_checkpoint


def _take_over(cfg: DictConfig, module: FittedModule, *, resumed: bool) -> None:
    """Initialises a fitted method from another run, where it supports that."""
    method = module.model
    if cfg.init_from is None and cfg.freeze is None:
        return
    if not isinstance(method, TakesOver) or cfg.freeze is not None or not cfg.init_from:
        takes, leave = "nothing", "both null"
        if isinstance(method, TakesOver):
            takes, leave = "only what a named run of another method has found", "freeze null, name a run or none"
        raise ConfigError(
            f"init_from, freeze: {module.method_name} is fitted to its own sequences and takes {takes} over. Leave "
            f"{leave}, and train on the new sequences."
        )
    if not resumed:
        method.take_over(load_run(cfg.init_from).module.model)


# ------------------------------------------------------------------------------------------------ simulators


def _begin(cfg: DictConfig, module: GausSimModule, datamodule: ReadyDataModule, *, resumed: bool) -> None:
    """Copies weights of another run and freezes them if configured; sets where free bodies begin."""
    if cfg.init_from == "":
        raise ConfigError("init_from: name the trained run whose network this one starts from (init_from=RUN).")
    if cfg.freeze not in (None, "network", "model"):
        raise ConfigError(f"freeze: expected null, network or model, got '{cfg.freeze}'.")
    if cfg.freeze and cfg.init_from is None:
        raise ConfigError("freeze: a network at random would stay so. Name a trained run (init_from=RUN).")
    model = cast(GausSim, module.model)
    if cfg.init_from is not None and not resumed:
        load = load_simulator if cfg.freeze == "model" else load_shared
        load(model, cfg.init_from, plain(cfg)["model"])
    if cfg.freeze:
        model.freeze(scenes=cfg.freeze == "model")
    if module.initial_states is not None:
        begin_free_bodies(module, datamodule)
    decodes = isinstance(model.template, MaterialTemplate)
    if isinstance(datamodule, CorpusDataModule) and decodes and not datamodule.knows_material and not resumed:
        find_materials(model, datamodule)


def _train(
    cfg: DictConfig, run: RunDirectory, module: GausSimModule, datamodule: ReadyDataModule, resume: Path | None,
    settings: TrainerSettings,
) -> dict[str, Any]:  # fmt: skip
    callbacks = settings.callbacks(has_videos=cfg.data._target_ != CORPUS)
    wanted = (cfg.logger or {}).items() if is_first() else ()
    loggers = [instantiate(n, save_dir=str(run.path), **FOLDERS.get(str(k), {})) for k, n in wanted if n]
    epochs = module.plan.epochs or 1
    trainer = make_trainer(settings, epochs=epochs, run_dir=run.path, callbacks=callbacks, loggers=loggers)
    for logger in trainer.loggers:
        logger.log_hyperparams(plain(cfg))
    if is_first():
        datamodule.setup("fit")
        place = str(trainer.strategy.root_device)
        ranks = f"{trainer.world_size} ranks, " if trainer.world_size > 1 else ""
        lines = _course(module, datamodule, run.config())
        _introduce(run, module, datamodule, place, lines, resumed=resume is not None, ranks=ranks)
    try:
        trainer.fit(module, datamodule=datamodule, ckpt_path=resume, weights_only=True)
    finally:
        run.has_stepped = module.global_step > 0
    if trainer.interrupted:
        raise KeyboardInterrupt
    return _facts(trainer, module) if is_first() else {}


def _facts(trainer: Trainer, module: GausSimModule) -> dict[str, Any]:
    """Facts that a finished run records."""
    # `processed` counts them; `current_epoch` lags behind in a run that is resumed after its last save.
    epochs = cast(Any, trainer.fit_loop.epoch_progress.current).processed
    facts: dict[str, Any] = {"epochs": epochs, "optimizer_steps": module.global_step, "last_epoch": module.summary}
    rows = Table(Path(trainer.default_root_dir) / EPOCHS, "epoch").rows()
    full = [row for row in rows if row.get("excess_static") and row["steps"] == rows[-1]["steps"]]  # of the largest T
    falls = still_falls([float(row["excess_static"]) for row in full])
    return facts | ({} if falls is None else {"still_falls": falls})


def still_falls(losses: Sequence[float], *, share: float = 0.2, tolerance: float = 0.01) -> bool | None:
    """Whether the mean of the last ``share`` of the losses is lower than that before it by more than ``tolerance``.

    None with fewer than two epochs in each part.
    """
    count = int(share * len(losses))
    if count < 2:
        return None
    now, before = (sum(part) / count for part in (losses[-count:], losses[-2 * count : -count]))
    return now < (1 - tolerance) * before


# ------------------------------------------------------------------------------------------------ introduction


def _introduce(
    run: RunDirectory, module: GausSimModule | FittedModule, datamodule: ReadyDataModule, place: str,
    lines: Sequence[str], *, resumed: bool, ranks: str = "",
) -> None:  # fmt: skip
    """Prints device, data, parameters and course of a training."""
    count = torch.get_num_threads()
    threads = f"({ranks}{count} torch thread{'s' if count != 1 else ''})"
    print(f"{'resuming' if resumed else 'training'} on {place} {threads}: {run.path}")
    kernels = sum(scene.count for scene in module.scenes)
    pinned = sum(int(scene.pinned.sum()) for scene in module.scenes)
    print("".join(f"  {line}\n" for line in datamodule.introduction()) + f"  {kernels} kernels ({pinned} pinned)")
    sizes = {name: sum(p.numel() for p in own) for name, own in module.groups().items()}
    print("  parameters: " + (", ".join(f"{name} {count}" for name, count in sizes.items()) or "none"))
    print("".join(f"  {line}\n" for line in lines), end="", flush=True)


def _course(module: GausSimModule, datamodule: ReadyDataModule, config: dict[str, Any]) -> list[str]:
    """Supervision, epochs and T of a training, and warnings."""
    kind, plan, batches = type(module.supervision).__name__, module.plan, len(datamodule.train_dataloader())
    epochs = plan.epochs or 1
    shows, frames = epochs * plan.repeats, sum(plan.steps(epoch) * batches for epoch in range(epochs))
    lines = [
        f"compared with {COMPARED.get(kind, kind)}",
        f"{epochs} epochs of {batches} steps, {shows} uses of each sequence; "
        f"T {plan.steps(0)} to {plan.t_max}, {frames} predicted frames",
        *_slow_beginnings(module, shows),
    ]
    source = config.get("init_from")
    if source and (others := unlike(source, config["model"])):  # in another model weights mean something else
        lines.append(f"warning: {source} was trained with other values of {', '.join(others)}")
    return lines


def _slow_beginnings(module: GausSimModule, shows: int) -> list[str]:
    """A warning if initial states cannot reach the first step of a typical motion within ``shows``."""
    states, rate = cast(Any, module.initial_states), module.settings.initial_lr
    if states is None or module.plan.warm_start or module.plan.teach:  # which find them in the tracks
        return []
    reach = states.reach(rate * shows)
    if reach >= FIRST_STEP:
        return []
    return [
        f"warning: in {shows} uses of a sequence at optimizer.initial_lr={rate:g} an initial state moves by "
        f"{reach:.2g} of the diagonal at most; objects that are pushed move by up to {FIRST_STEP:g} in their first "
        f"frame. Raise optimizer.initial_lr to {rate * FIRST_STEP / max(reach, 1e-12):.2g}, or plan.epochs."
    ]
