"""Training of a run as `gausim train` and `gausim adapt` do it: from a configuration to a finished directory."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf

from gausim.cli.output import end
from gausim.cli.sweeps.jobs import do_job
from gausim.compose.build import CORPUS, build, load_run, with_resolved_plan
from gausim.compose.command import run_dir
from gausim.compose.config import instantiate
from gausim.compose.root import in_sweep
from gausim.core import ConfigError, FittedMethod, RunError, TakesOver
from gausim.data.datamodule import ReadyDataModule
from gausim.data.pretraining import CorpusDataModule
from gausim.doctor.examine import examine
from gausim.doctor.page import findings_text
from gausim.models.step.simulator import GausSim
from gausim.results.looks import TEST_PART
from gausim.runs.directory import RunDirectory
from gausim.runs.names import EPOCHS
from gausim.training.first_frames import begin_free_bodies
from gausim.training.fitted.fitting import StagedFit
from gausim.training.material_scan import find_materials
from gausim.training.module import GausSimModule
from gausim.training.ranks.launch import Crew
from gausim.training.table import Table
from gausim.training.trainer import make_trainer
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


def train(cfg: DictConfig) -> float | None:
    """Trains one run; returns its last loss above the floor as a fraction of the static prediction's.

    In a sweep errors do not stop the other jobs: they are logged and repeated in the summary at the end.

    Raises:
        GausSimError: the run is finished, has another configuration, is damaged or in use, or training diverged.
    """
    run = RunDirectory(run_dir())
    if in_sweep():
        return do_job(cfg, run, train_run)
    with run.writing():
        return train_run(cfg, run)


def train_run(cfg: DictConfig, run: RunDirectory) -> float | None:
    """Trains into a run directory locked by this process, and evaluates the run if configured."""
    with run.leaving_no_trace(Path(cfg.output_root)):
        cfg = with_resolved_plan(cfg)
        if cfg.evaluate and not cfg.overwrite and run.awaits_evaluation(_plain(cfg)):
            objective = run.facts()["last_epoch"].get("excess_static")
        else:
            objective = _train(cfg, run)
    if cfg.evaluate:
        _evaluate(run)
    return objective


def _plain(cfg: DictConfig) -> dict[str, Any]:
    """The whole configuration, resolved."""
    return cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True))


def _evaluate(run: RunDirectory) -> None:
    """`gausim evaluate RUN` in a separate process, so that it measures time and memory of predictions alone."""
    if getattr(rank_zero_only, "rank", 0):
        return
    part = run.config()["data"].get("part")
    command = [sys.executable, "-m", "gausim.cli.main", "evaluate", str(run.path), *["--test"] * (part == "test")]
    status = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())}).returncode
    if status:
        raise RunError(
            f"{run.path}: trained, but its evaluation failed with exit status {status} (its message stands above). "
            "Give the same command again to evaluate it, or use `gausim evaluate`."
        )


def _train(cfg: DictConfig, run: RunDirectory) -> float | None:
    with run.recording_failure(), Crew(instantiate(cfg.trainer), follow) as crew:
        if not crew.is_first:  # started by a scheduler beside the first rank
            return follow(crew)
        config = _plain(cfg)
        task = crew.ranks.first(lambda: (config, str(run.path), run.prepare(config, overwrite=cfg.overwrite)))
        parts = _parts(cfg, resumed=task[2] is not None)
        crew.start(task)
        return _fit(cfg, run, task[2], parts, crew)


def follow(crew: Crew) -> float | None:
    """Trains as one of the other ranks, with the configuration of the first one and without writing files."""
    task: Any = crew.ranks.first(lambda: None)
    config, path, resume = task
    cfg = OmegaConf.create(config)
    return _fit(cfg, RunDirectory(path), resume, _parts(cfg, resumed=resume is not None), crew)


def _parts(cfg: DictConfig, *, resumed: bool) -> tuple[GausSimModule, ReadyDataModule]:
    seed_everything(cfg.seed, workers=True, verbose=False)
    module, datamodule = build(cfg)
    check_protocol(cfg, datamodule)
    if "joint" in str(cfg.ablation.name).split("+") and len(datamodule.objects) == 1:
        raise ConfigError(
            f"ablation=joint: expected several objects, the data have {datamodule.objects[0].name} alone."
        )
    _take_over(cfg, module, resumed=resumed)
    if module.initial_states is not None:
        begin_free_bodies(module, datamodule)
    if isinstance(datamodule, CorpusDataModule) and not datamodule.knows_material and not resumed:
        find_materials(cast("GausSim", module.model), datamodule)
    return module, datamodule


def check_protocol(cfg: DictConfig, datamodule: ReadyDataModule) -> None:
    """Raises ConfigError where the evaluation after training could not be made as the protocol demands."""
    part, trials = cfg.data.get("part"), cfg.trials
    if not cfg.evaluate or not datamodule.has_videos:
        return
    names = [(item.test_part, record.name) for item in datamodule.objects for record in item.sequences]
    reserved = [name in part_of for part_of, name in names]
    if part == TEST_PART and not trials:
        raise ConfigError(
            f"trials: expected the number of trials made on the development part for a look at the test part "
            f"(data.part=test), got {trials}."
        )
    if part != TEST_PART and all(reserved):
        raise ConfigError(
            "evaluate: all sequences of the data belong to the test part. Set data.part=test and trials=N (N made "
            "on the development part), or evaluate=false."
        )


def _fit(
    cfg: DictConfig, run: RunDirectory, resume: Path | None, parts: tuple[GausSimModule, ReadyDataModule], crew: Crew
) -> float | None:
    module, datamodule = parts
    plan = module.method.plan if isinstance(module.method, StagedFit) else None
    trainer = _trainer(cfg, run, crew, epochs=(module.plan.epochs or 1) if plan is None else plan.epochs)
    faults: list[str] = []
    for logger in trainer.loggers:
        logger.log_hyperparams(_plain(cfg))
    if crew.is_first:
        _introduce(trainer, module, datamodule, run, resumed=resume is not None)
        if cfg.doctor and not in_sweep():
            faults = _warn_of_data(datamodule)
    try:
        trainer.fit(module, datamodule=datamodule, ckpt_path=resume, weights_only=True)
    finally:
        run.has_stepped = module.global_step > 0
    if plan is not None and not plan.order:  # no trained stage, so no epoch has saved a checkpoint
        trainer.save_checkpoint(run.checkpoint, weights_only=False)
    if trainer.interrupted:
        raise KeyboardInterrupt
    if crew.is_first:
        facts = _facts(trainer, module) | ({"data_faults": faults} if faults else {})
        run.finish(facts)
        commands = [] if cfg.evaluate or not datamodule.has_videos else [["evaluate", run.path], ["report", run.path]]
        end(_result(facts), "run", run.path, *commands)
    return module.summary.get("excess_static")


def _facts(trainer: Trainer, module: GausSimModule) -> dict[str, Any]:
    """Facts that a finished run records."""
    # `processed` counts them; `current_epoch` lags behind in a run that is resumed after its last save.
    epochs = cast(Any, trainer.fit_loop.epoch_progress.current).processed
    facts: dict[str, Any] = {"epochs": epochs, "optimizer_steps": module.global_step, "last_epoch": module.summary}
    if isinstance(module.method, StagedFit):
        facts["notes"] = module.notes()
    rows = Table(Path(trainer.default_root_dir) / EPOCHS, "epoch").rows()
    full = [row for row in rows if row.get("excess_static") and row["steps"] == rows[-1]["steps"]]  # of the largest T
    falls = still_falls([float(row["excess_static"]) for row in full])
    return facts | ({} if falls is None else {"still_falls": falls})


def _result(facts: dict[str, Any]) -> list[str]:
    """Sentences on the training time, the error on training frames, and faults of the data."""
    more = [
        f"The data are faulty, and so is what it learned from them. {fault} Mend that and train again: "
        "`gausim doctor ROOT` has the remedy."
        for fault in facts.get("data_faults", ())
    ]
    excess = facts["last_epoch"].get("excess_static")
    begin = f"Trained for {facts['epochs']} epochs ({facts['optimizer_steps']} steps)"
    if excess is None or excess < -1:  # the motion is smaller than the error of the reconstruction
        return [f"{begin}.", *more]
    falls = {True: " and still falls", False: " and no longer falls", None: ""}[facts.get("still_falls")]
    return [
        f"{begin}: on training frames, the loss beyond the reconstruction's is {100 * excess:.0f} % of the static "
        f"prediction's{falls}.",
        *more,
    ]


def still_falls(losses: Sequence[float], *, share: float = 0.2, tolerance: float = 0.01) -> bool | None:
    """Whether the mean of the last ``share`` of the losses is lower than that before it by more than ``tolerance``.

    None with fewer than two epochs in each part.
    """
    count = int(share * len(losses))
    if count < 2:
        return None
    now, before = (sum(part) / count for part in (losses[-count:], losses[-2 * count : -count]))
    return now < (1 - tolerance) * before


def _warn_of_data(datamodule: ReadyDataModule) -> list[str]:
    """Prints faults and warnings of `gausim doctor` on the objects; returns one sentence per fault."""
    faults: list[str] = []
    for item in datamodule.objects:
        found = examine(item, item.scene()).graver
        if found.findings:
            print(findings_text(str(item.root), found), flush=True)
        faults += [f"{item.name}: {finding.what}" for finding in found.findings if finding.severity == "fault"]
    return faults


def _take_over(cfg: DictConfig, module: GausSimModule, *, resumed: bool) -> None:
    """Copies weights of another run (unless resumed from a checkpoint), and freezes them if configured."""
    if isinstance(module.method, StagedFit):
        _take_over_fit(cfg, module.method.fitted, resumed=resumed)
        return
    if cfg.init_from == "":
        raise ConfigError("init_from: name the trained run whose network this one starts from (init_from=RUN).")
    if cfg.freeze not in (None, "network", "model"):
        raise ConfigError(f"freeze: expected null, network or model, got '{cfg.freeze}'.")
    if cfg.freeze and cfg.init_from is None:
        raise ConfigError("freeze: a network at random would stay so. Name a trained run (init_from=RUN).")
    if cfg.init_from is not None and not resumed:
        load = load_simulator if cfg.freeze == "model" else load_shared
        load(cast("GausSim", module.model), cfg.init_from, _plain(cfg)["model"])
    if cfg.freeze:
        cast("GausSim", module.model).freeze(scenes=cfg.freeze == "model")


def _take_over_fit(cfg: DictConfig, method: FittedMethod, *, resumed: bool) -> None:
    """The same for a fitted method that supports initialisation from another run."""
    if cfg.init_from is None and cfg.freeze is None:
        return
    if not isinstance(method, TakesOver) or cfg.freeze is not None or not cfg.init_from:
        takes, leave = "nothing", "both null"
        if isinstance(method, TakesOver):
            takes, leave = "only what a named run of another method has found", "freeze null, name a run or none"
        raise ConfigError(
            f"init_from, freeze: {method.name} is fitted to its own sequences and takes {takes} over. Leave {leave}, "
            "and train on the new sequences."
        )
    if not resumed:
        source = load_run(cfg.init_from).module
        method.take_over(source.method.fitted if isinstance(source.method, StagedFit) else source.simulator)


def _trainer(cfg: DictConfig, run: RunDirectory, crew: Crew, *, epochs: int) -> Trainer:
    """The trainer of a configuration, with its callbacks and, on the first rank, loggers that write into the run."""
    settings = instantiate(cfg.trainer)
    callbacks = settings.callbacks(has_videos=cfg.data._target_ != CORPUS)
    wanted = (cfg.logger or {}).items() if crew.is_first else ()
    loggers = [instantiate(n, save_dir=str(run.path), **FOLDERS.get(str(k), {})) for k, n in wanted if n]
    return make_trainer(settings, epochs=epochs, run_dir=run.path, callbacks=callbacks, loggers=loggers, crew=crew)


def _introduce(
    trainer: Trainer, module: GausSimModule, datamodule: ReadyDataModule, run: RunDirectory, *, resumed: bool
) -> None:
    datamodule.setup("fit")
    count = torch.get_num_threads()
    ranks = f"{trainer.world_size} ranks, " if trainer.world_size > 1 else ""
    threads = f"({ranks}{count} torch thread{'s' if count != 1 else ''})"
    print(f"{'resuming' if resumed else 'training'} on {trainer.strategy.root_device} {threads}: {run.path}")
    kernels = sum(scene.count for scene in module.simulator.scenes)
    pinned = sum(int(scene.pinned.sum()) for scene in module.simulator.scenes)
    print("".join(f"  {line}\n" for line in datamodule.introduction()) + f"  {kernels} kernels ({pinned} pinned)")
    sizes = {name: sum(p.numel() for p in own) for name, own in module.groups().items()}
    print("  parameters: " + (", ".join(f"{name} {count}" for name, count in sizes.items()) or "none"))
    if isinstance(module.method, StagedFit):
        lines = [f"{name}: {stage.iterations} iterations per sequence" for name, stage in module.method.plan.order]
        lines += [f"note: {note}" for note in module.method.fitted.notes()]
    else:
        kind = type(module.supervision).__name__
        plan, batches = module.plan, len(datamodule.train_dataloader())
        epochs = plan.epochs or 1
        shows, frames = epochs * plan.repeats, sum(plan.steps(epoch) * batches for epoch in range(epochs))
        lines = [
            f"compared with {COMPARED.get(kind, kind)}",
            f"{epochs} epochs of {batches} steps, {shows} shows of each sequence; "
            f"T {plan.steps(0)} to {plan.t_max}, {frames} predicted frames",
            *_slow_beginnings(module, shows),
        ]
        config = run.config()
        source = config.get("init_from")
        if source and (others := unlike(source, config["model"])):  # in another model weights mean something else
            lines.append(f"warning: {source} was trained with other values of {', '.join(others)}")
    print("".join(f"  {line}\n" for line in lines), end="", flush=True)


def _slow_beginnings(module: GausSimModule, shows: int) -> list[str]:
    """A warning if initial states cannot reach the first step of a typical motion within ``shows``."""
    states, rate = cast(Any, module.initial_states), module.settings.initial_lr
    if states is None:
        return []
    reach = states.reach(rate * shows)
    if reach >= FIRST_STEP:
        return []
    return [
        f"warning: in {shows} shows at optimizer.initial_lr={rate:g} an initial state moves by {reach:.2g} of the "
        f"diagonal at most; objects that are pushed move by up to {FIRST_STEP:g} in their first frame. Raise "
        f"optimizer.initial_lr to {rate * FIRST_STEP / max(reach, 1e-12):.2g}, or plan.epochs."
    ]
