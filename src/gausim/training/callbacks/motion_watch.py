"""Motion errors during training, on seen and unseen frames."""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from gausim.core import ConfigError, DivergenceError
from gausim.data.objects import ObjectData
from gausim.data.records import GroundTruth
from gausim.nn.mode import evaluating
from gausim.runs.names import MOTION
from gausim.runs.randomness import undisturbed
from gausim.training.callbacks.cadence import has_come, training_data
from gausim.training.module import GausSimModule
from gausim.training.supervision.points import attach_points
from gausim.training.table import Table, short


class MotionWatch(Callback):
    """Predicts the first training sequences of every object whose true motion is known, and measures the errors.

    It uses unseen frames, as evaluation does, without an effect on training, and leaves the test part out. Errors are
    over the static prediction's, ``cpu_seconds`` the processor time of the training without that of this callback.
    Rows go to ``motion.csv`` of the run, means over objects to every logger. Epoch 0 is after the plan's first stages.
    """

    COLUMNS = ("epoch", "step", "object", "cpu_seconds", "error_seen", "error_unseen")
    SEQUENCES = 4  # of each object

    def __init__(self, *, every_epochs: int = 10) -> None:
        """Measures before the first epoch, every ``every_epochs`` epochs and after the last; never if it is 0."""
        if every_epochs < 0:
            raise ConfigError(f"trainer.motion_epochs: expected at least 0, got {every_epochs}.")
        self._every, self._spent = every_epochs, 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Drops rows of epochs that a resumed run repeats."""
        if trainer.is_global_zero:
            self._table(trainer).resume_at(trainer.current_epoch)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Measures what the first stages have reached."""
        if trainer.is_global_zero and self._every and trainer.global_step == 0:
            self._write(trainer, pl_module, 0)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Measures if the epoch is due."""
        if trainer.is_global_zero and has_come(trainer, self._every):
            self._write(trainer, pl_module, trainer.current_epoch + 1)

    def state_dict(self) -> dict[str, float]:
        """Processor time of the measurements [s]."""
        return {"spent": self._spent}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Restores the time."""
        self._spent = state_dict["spent"]

    def _write(self, trainer: Trainer, module: LightningModule, epoch: int) -> None:
        assert isinstance(module, GausSimModule)
        began, spent = time.process_time(), 60 * module.cost.minutes("cpu") - self._spent
        with undisturbed(), torch.no_grad(), evaluating(module):
            rows = self._measure(trainer, module)
        self._spent += time.process_time() - began
        for name, row in rows.items():
            place = {"epoch": epoch, "step": trainer.global_step, "object": name, "cpu_seconds": short(spent)}
            self._table(trainer).append({**place, **{key: short(value) for key, value in row.items()}})
        values = {key: [row[key] for row in rows.values() if key in row] for key in self.COLUMNS[4:]}
        means = {f"motion/{key}": float(np.mean(known)) for key, known in values.items() if known}
        for logger in trainer.loggers if means else ():
            logger.log_metrics(means, step=trainer.global_step)

    def _table(self, trainer: Trainer) -> Table:
        return Table(Path(trainer.default_root_dir) / MOTION, "epoch", self.COLUMNS)

    def _measure(self, trainer: Trainer, module: GausSimModule) -> dict[str, dict[str, float]]:
        rows, first, data = {}, 0, training_data(trainer)
        for scene_id, item in enumerate(data.objects):
            if found := list(self._predicted(module, item, scene_id, first)):
                seen = item.train_frames.stop
                errors = {"error_seen": _ratio(found, slice(1, seen)), "error_unseen": _ratio(found, slice(seen, None))}
                rows[item.name] = {name: value for name, value in errors.items() if value is not None}
            first += len(item.sequences)
        return rows

    def _predicted(
        self, module: GausSimModule, item: ObjectData, scene_id: int, first: int
    ) -> Iterator[tuple[GroundTruth, Tensor]]:
        """True and predicted motion of each sequence."""
        points = item.rest_points
        if points is None:
            return
        scene = module.simulator.scenes[scene_id]
        attached = attach_points(scene, points)
        # Unseen frames of the test part, whose sequences have a limit, may not be looked at.
        shown = [pair for pair in enumerate(item.sequences) if pair[1].limit is None]
        for number, record in shown[: self.SEQUENCES]:
            truth = item.ground_truth(record)
            if truth is None:
                continue
            try:
                made = module.predict(first + number, len(truth.positions) - 1)
            except DivergenceError as error:
                module.print(f"motion of {item.name}/{record.name} was not measured: {error}")
                continue
            yield truth, made.carry(truth.rest, attached, scene.means).to(truth.positions)


def _ratio(found: Sequence[tuple[GroundTruth, Tensor]], frames: slice) -> float | None:
    """Mean distance of the points from the truth over all sequences, over that of standing still; None without any."""
    pairs = [
        (points[frames] - truth.positions[frames], truth.rest - truth.positions[frames]) for truth, points in found
    ]
    own, still = (sum(float(pair[i].double().norm(dim=-1).mean(-1).sum()) for pair in pairs) for i in (0, 1))
    return own / still if still > 0 else None
