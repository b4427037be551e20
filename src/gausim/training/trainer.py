"""The Lightning trainer of a run."""

import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins.environments import LightningEnvironment

from gausim.core import ConfigError
from gausim.runs.checkpoint import AtomicCheckpointIO
from gausim.runs.cost import keep_freed_memory
from gausim.training.callbacks.resume import ExactResume, RunCheckpoint
from gausim.training.ranks.launch import RanksStrategy
from gausim.training.ranks.layout import Layout


@dataclass(frozen=True)
class TrainerSettings(Layout):
    """Precision and devices of a training: the keys of ``conf/trainer`` explain the settings."""

    threads: int | None = 1
    progress: bool = True
    log_every_n_steps: int = 20
    checkpoint_minutes: float = 1.0
    checkpoint_steps: int = 0
    panel_epochs: int = 5
    motion_epochs: int = 10

    def callbacks(self) -> list[Callback]:
        """The callbacks that save, report and watch a run."""
        from gausim.training.callbacks.motion_watch import MotionWatch
        from gausim.training.callbacks.panels import Panels
        from gausim.training.callbacks.progress import EpochSummary, Progress

        saving = RunCheckpoint(every_minutes=self.checkpoint_minutes, every_steps=self.checkpoint_steps)
        found: list[Callback] = [saving, EpochSummary(console=self.progress)]
        found += [Panels(every_epochs=self.panel_epochs)] if self.panel_epochs else []
        found += [MotionWatch(every_epochs=self.motion_epochs)] if self.motion_epochs else []
        return [*found, Progress()] if self.progress else found


def make_trainer(
    settings: TrainerSettings,
    *,
    epochs: int,
    run_dir: Path | None = None,
    callbacks: Sequence[Callback] = (),
    loggers: Sequence[Logger] = (),
) -> Trainer:
    """The Lightning trainer of a run of ``epochs``, those of the module's plan.

    Files go to ``run_dir``, which several ranks need.

    Raises:
        ConfigError: more than one rank without a run directory.
    """
    if settings.size != 1 and run_dir is None:
        raise ConfigError(
            f"trainer.devices: expected 1 without a run directory, whose configuration other ranks read, got "
            f"{settings.size}."
        )
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    keep_freed_memory()
    # Its notes on devices, and on services to log in to, would stand between those of the run; its other warnings stay.
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    for note in (".*isinstance.treespec, LeafSpec.", ".*number of training batches .* is smaller than the logging"):
        warnings.filterwarnings("ignore", note)
    return Trainer(
        max_epochs=epochs,
        accelerator=settings.accelerator,
        devices=settings.devices,
        num_nodes=settings.num_nodes,
        strategy="auto" if settings.size == 1 or run_dir is None else RanksStrategy(settings, run_dir),
        logger=list(loggers) or False,
        callbacks=[*callbacks, ExactResume()],
        log_every_n_steps=settings.log_every_n_steps,
        enable_progress_bar=settings.progress,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        limit_val_batches=0,
        use_distributed_sampler=False,  # our sampler divides the batches
        default_root_dir=None if run_dir is None else str(run_dir),
        # One process is alone, whatever variables a scheduler has left.
        plugins=[AtomicCheckpointIO(), *[LightningEnvironment()] * (settings.size == 1)],
    )
