"""The Lightning trainer of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.loggers import Logger

from gausim.core import ConfigError
from gausim.runs.checkpoint import AtomicCheckpointIO
from gausim.runs.memory import keep_freed_memory
from gausim.training.callbacks.convergence import Convergence
from gausim.training.callbacks.resume import ExactResume
from gausim.training.callbacks.time_budget import TimeBudget
from gausim.training.ranks.launch import Crew
from gausim.training.ranks.layout import RanksStrategy


def make_trainer(
    *,
    max_epochs: int,
    accelerator: str = "auto",
    devices: int = 1,
    num_nodes: int = 1,
    timeout_minutes: float = 10.0,
    threads: int | None = None,
    precision: str = "32-true",
    max_minutes: float | None = None,
    clock: str = "wall",
    log_every_n_steps: int = 20,
    progress: bool = True,
    convergence: Convergence | None = None,
    run_dir: Path | str | None = None,
    callbacks: Sequence[Callback] = (),
    loggers: Sequence[Logger] = (),
    crew: Crew | None = None,
) -> Trainer:
    """The Lightning trainer of a run.

    Args:
        max_epochs: epochs of the whole run.
        accelerator: ``auto``, ``cpu`` or ``gpu``.
        devices: ranks on each machine; more than one need a crew.
        num_nodes: machines.
        timeout_minutes: how long ranks wait for each other; :class:`~gausim.training.ranks.layout.Layout` has it.
        threads: of torch's operators on the CPU, for each rank; None leaves the process's own number.
        precision: Lightning's name of it.
        max_minutes: time budget; None is without.
        clock: what the budget counts, ``wall`` or ``cpu`` time.
        log_every_n_steps: optimiser steps between rows of the loggers.
        progress: whether a progress bar is shown.
        convergence: ends the run when it has learned; None leaves it all of its epochs.
        run_dir: where checkpoints, panels and tables go.
        callbacks: further ones.
        loggers: where numbers go.
        crew: the ranks, where there are several.

    Raises:
        ConfigError: more than one rank without a crew.
    """
    environment = crew.environment if crew is not None else None
    if devices * num_nodes != 1 and environment is None:
        raise ConfigError(
            f"trainer.devices: expected 1, got {devices} on {num_nodes} machines; several ranks train by `gausim "
            "train` only, which starts them."
        )
    if threads is not None:
        torch.set_num_threads(threads)
    keep_freed_memory()
    own: list[Callback] = [] if convergence is None else [convergence]  # before what tells of its judgement
    own += [c for c in callbacks if progress or not isinstance(c, ProgressBar)]
    if max_minutes is not None:
        own.append(TimeBudget(minutes=max_minutes, clock=clock))
    own.append(ExactResume())
    return Trainer(
        max_epochs=max_epochs,
        accelerator=accelerator,
        devices=devices,
        num_nodes=num_nodes,
        strategy="auto" if environment is None else RanksStrategy(),
        precision=precision,  # type: ignore[arg-type]
        logger=list(loggers) or False,
        callbacks=own,
        log_every_n_steps=log_every_n_steps,
        enable_progress_bar=progress,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        limit_val_batches=0,
        use_distributed_sampler=False,  # the sampler deals out shares itself
        default_root_dir=str(run_dir) if run_dir is not None else None,
        plugins=[AtomicCheckpointIO(), *([] if environment is None else [environment])],
    )
