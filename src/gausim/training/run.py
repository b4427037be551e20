"""Training of a simulator: its beginning, what is printed of it, and the fit by Lightning."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from lightning.pytorch import Trainer
from lightning.pytorch.loggers import Logger

from gausim.core import ConfigError
from gausim.data.datamodule import ReadyDataModule
from gausim.models.step.simulator import GausSim
from gausim.runs.names import EPOCHS
from gausim.training.first_frames import begin_free_bodies
from gausim.training.module import GausSimModule
from gausim.training.table import Table
from gausim.training.trainer import TrainerSettings, make_trainer
from gausim.training.transfer import load_shared, load_simulator, unlike

# Largest first displacement per frame observed for small pushes [diagonals].
FIRST_STEP = 0.065
COMPARED = {
    "ImageSupervision": "the images (supervision=images)",
    "TrackSupervision": "motion tracked in the images (supervision=tracks), each frame when it is first shown",
    "PointSupervision": "true points (supervision=points)",
}


def begin(module: GausSimModule, data: ReadyDataModule, config: Mapping[str, Any], *, resumed: bool) -> None:
    """Copies weights of another run and freezes them if configured; sets where free bodies begin.

    Raises:
        ConfigError: ``init_from`` or ``freeze`` is wrong.
    """
    source, freeze, model = config["init_from"], config["freeze"], cast(GausSim, module.model)
    if source == "":
        raise ConfigError("init_from: name the trained run whose network this one starts from (init_from=RUN).")
    if freeze not in (None, "network", "model"):
        raise ConfigError(f"freeze: expected null, network or model, got '{freeze}'.")
    if freeze and source is None:
        raise ConfigError("freeze: a network at random would stay so. Name a trained run (init_from=RUN).")
    if source is not None and not resumed:
        load = load_simulator if freeze == "model" else load_shared
        load(model, source, config["model"])
    if freeze:
        model.freeze(scenes=freeze == "model")
    begin_free_bodies(module, data)


def course(module: GausSimModule, data: ReadyDataModule, config: Mapping[str, Any]) -> list[str]:
    """Supervision, epochs and T of a training, and warnings."""
    data.setup("fit")
    kind, plan, batches = type(module.supervision).__name__, module.plan, len(data.train_dataloader())
    epochs = plan.epochs or 1
    shows, frames = epochs * plan.repeats, sum(plan.steps(epoch) * batches for epoch in range(epochs))
    lines = [
        f"compared with {COMPARED.get(kind, kind)}",
        f"{epochs} epochs of {batches} steps, {shows} uses of each sequence; "
        f"T {plan.steps(0)} to {plan.t_max}, {frames} predicted frames",
        *_slow_beginnings(module, shows),
    ]
    source = config["init_from"]
    if source and (others := unlike(source, config["model"])):  # in another model weights mean something else
        lines.append(f"warning: {source} was trained with other values of {', '.join(others)}")
    return lines


def fit(
    module: GausSimModule, data: ReadyDataModule, settings: TrainerSettings, run_dir: Path, *, seed: int,
    resume: Path | None, loggers: Sequence[Logger],
) -> dict[str, Any]:  # fmt: skip
    """Trains a simulator, or continues from a checkpoint; returns facts about the training.

    Raises:
        KeyboardInterrupt: it was interrupted.
    """
    callbacks = settings.callbacks()
    epochs = module.plan.epochs or 1
    trainer = make_trainer(settings, epochs=epochs, run_dir=run_dir, callbacks=callbacks, loggers=loggers)
    trainer.fit(module, datamodule=data, ckpt_path=resume, weights_only=True)
    if trainer.interrupted:
        raise KeyboardInterrupt
    return _facts(trainer, module, run_dir)


def _facts(trainer: Trainer, module: GausSimModule, run_dir: Path) -> dict[str, Any]:
    # `processed` counts the epochs; `current_epoch` lags behind in a run that is resumed after its last save.
    epochs = cast(Any, trainer.fit_loop.epoch_progress.current).processed
    facts: dict[str, Any] = {"epochs": epochs, "optimizer_steps": module.global_step, "last_epoch": module.summary}
    rows = Table(run_dir / EPOCHS, "epoch").rows()
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
