"""Motion errors during training, on seen and unseen frames."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from gausim.core import ConfigError, DivergenceError
from gausim.data.records import GroundTruth
from gausim.metrics.motion import motion_energy
from gausim.nn.mode import evaluating
from gausim.runs.names import MOTION
from gausim.runs.randomness import undisturbed
from gausim.training.callbacks.cadence import has_come, training_data
from gausim.training.module import GausSimModule
from gausim.training.supervision.points import attach_points
from gausim.training.table import Table, short


class MotionWatch(Callback):
    """Predicts the first training sequences of every object whose true motion is known, and measures the errors.

    It uses unseen frames, as evaluation does, without an effect on training, and leaves the test part out. ``gap`` is
    the generalisation gap, the error on unseen frames less that on seen frames, both over the static prediction's. Rows
    go to ``motion.csv`` of the run, means over objects to every logger.
    """

    COLUMNS = ("epoch", "step", "object", "error_seen", "error_unseen", "gap", "energy_seen", "energy_unseen")

    def __init__(self, *, every_epochs: int = 10, sequences: int = 4) -> None:
        """Measures every ``every_epochs`` epochs (0: never) and after the last, on ``sequences`` of each object."""
        if every_epochs < 0 or sequences < 1:
            raise ConfigError(
                f"MotionWatch: expected every_epochs >= 0 and sequences >= 1, got {every_epochs} and {sequences}."
            )
        self._every, self._sequences = every_epochs, sequences

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Drops rows of epochs that a resumed run repeats."""
        if trainer.is_global_zero:
            self._table(trainer).resume_at(trainer.current_epoch)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Measures if the epoch is due."""
        if not (trainer.is_global_zero and has_come(trainer, self._every)):
            return
        assert isinstance(pl_module, GausSimModule)
        with undisturbed(), torch.no_grad(), evaluating(pl_module):
            rows = self._measure(trainer, pl_module)
        for name, row in rows.items():
            place = {"epoch": trainer.current_epoch + 1, "step": trainer.global_step, "object": name}
            self._table(trainer).append({**place, **{key: short(value) for key, value in row.items()}})
        values = {key: [row[key] for row in rows.values() if key in row] for key in self.COLUMNS[3:]}
        means = {f"motion/{key}": float(np.mean(known)) for key, known in values.items() if known}
        for logger in trainer.loggers if means else ():
            logger.log_metrics(means, step=trainer.global_step)

    def _table(self, trainer: Trainer) -> Table:
        return Table(Path(trainer.default_root_dir) / MOTION, "epoch", self.COLUMNS)

    def _measure(self, trainer: Trainer, module: GausSimModule) -> dict[str, dict[str, float]]:
        rows, first, data = {}, 0, training_data(trainer)
        for scene_id, item in enumerate(data.objects):
            found = list(self._predicted(module, item, scene_id, first)) if scene_id in data.watched else []
            first += len(item.sequences)
            if found:
                rows[item.name] = figures(found, item.train_frames.stop)
        return rows

    def _predicted(
        self, module: GausSimModule, item: Any, scene_id: int, first: int
    ) -> Iterator[tuple[GroundTruth, Tensor]]:
        """True and predicted motion of each sequence.

        ``item`` is the object, an ``ObjectData`` or a ``BodyData``.
        """
        points = item.rest_points
        if points is None:
            return
        scene = module.simulator.scenes[scene_id]
        attached = attach_points(scene, points)
        # Unseen frames of the test part, whose sequences have a limit, may not be looked at.
        shown = [pair for pair in enumerate(item.sequences) if getattr(pair[1], "limit", None) is None]
        for number, record in shown[: self._sequences]:
            truth = item.ground_truth(record)
            if truth is None:
                continue
            try:
                made = module.predict(first + number, len(truth.positions) - 1)
            except DivergenceError as error:
                module.print(f"motion of {item.name}/{record.name} was not measured: {error}")
                continue
            yield truth, made.carry(truth.rest, attached, scene.means).to(truth.positions)


def figures(found: Sequence[tuple[GroundTruth, Tensor]], unseen: int) -> dict[str, float]:
    """The figures of one object, without those that cannot be computed; ``unseen`` is the first unseen frame."""
    # Prediction and reference by frame, over all sequences: mean distance from the truth, and motion energy.
    errors, energies = [], []
    for truth, points in found:
        static = truth.rest.expand_as(truth.positions)
        errors.append([(x - truth.positions).norm(dim=-1).mean(-1).cpu().double().numpy() for x in (points, static)])
        energies.append([motion_energy(x).cpu().double().numpy() for x in (points, truth.positions)])
    row = {"error_seen": _ratio(errors, slice(1, unseen)), "error_unseen": _ratio(errors, slice(unseen, None))}
    row["gap"] = row["error_unseen"] - row["error_seen"]
    row["energy_seen"] = _ratio(energies, slice(0, unseen - 1))
    row["energy_unseen"] = _ratio(energies, slice(unseen - 1, None))
    return {name: value for name, value in row.items() if np.isfinite(value)}


def _ratio(pairs: Sequence[Sequence[np.ndarray]], span: slice) -> float:
    own, reference = (sum(float(pair[i][span].sum()) for pair in pairs) for i in (0, 1))
    return own / reference if reference > 0 else float("nan")
