"""Pictures of training: ground truth, prediction and error, one frame per column."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from gausim.core import DivergenceError
from gausim.data.dataset import SequenceSample
from gausim.data.images import composite
from gausim.engine.module import GausSimModule
from gausim.render.draw import to_bytes

# Errors are drawn this much brighter, and stated so in the file's name.
ERROR_GAIN = 4.0


def panel(
    truth: Float[Tensor, "F H W 3"], prediction: Float[Tensor, "F H W 3"], *, columns: int = 6, gap: int = 2
) -> UInt8[Tensor, "R C 3"]:
    """Three rows (ground truth, prediction, error times four) of evenly spread frames, the first and the last too."""
    count = truth.shape[0]
    chosen = sorted({round(i * (count - 1) / max(1, columns - 1)) for i in range(columns)})
    error = (truth - prediction).abs() * ERROR_GAIN
    rows = []
    for images in (truth, prediction, error):
        padded = torch.nn.functional.pad(images[chosen], (0, 0, 0, gap, 0, gap), value=0.25)
        rows.append(torch.cat(list(padded), 1))
    return to_bytes(torch.cat(rows, 0))


class ImagePanels(Callback):
    """Writes a panel of one training sequence to ``panels/`` of the run and to TensorBoard every few epochs."""

    def __init__(self, *, every_epochs: int = 5, columns: int = 6) -> None:
        """Keeps the settings.

        Args:
            every_epochs: epochs between panels; the last epoch always gets one. 0 is never.
            columns: at most so many frames side by side.
        """
        self._every, self._columns = every_epochs, columns
        self._sample: SequenceSample | None = None

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Remembers the sequence with the lowest number, so that panels of one run can be compared."""
        for sample in batch:
            if self._sample is None or sample.sequence_id <= self._sample.sequence_id:
                self._sample = sample

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draws the panel when its epoch has come."""
        assert isinstance(pl_module, GausSimModule)
        epoch = trainer.current_epoch
        last = trainer.should_stop or epoch + 1 == trainer.max_epochs
        if self._sample is None or not self._every or not (last or (epoch + 1) % self._every == 0):
            return
        try:
            prediction = pl_module.predict_images(self._sample)[:, 0]
        except DivergenceError as error:
            pl_module.print(f"no panel for epoch {epoch + 1}: {error}")
            return
        truth = composite(self._sample.frames[:, 0])[0]
        image = panel(truth, prediction, columns=self._columns).cpu()
        name = f"{self._sample.object_name}_{self._sample.sequence_name}"
        write_image(Path(trainer.default_root_dir) / "panels" / f"epoch_{epoch + 1:04d}_{name}.png", image)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image(f"panels/{name}", image, pl_module.global_step, dataformats="HWC")


def write_image(path: Path, image: UInt8[Tensor, "H W 3"]) -> None:
    """Writes RGB as PNG.

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), cv2.cvtColor(np.ascontiguousarray(image.numpy()), cv2.COLOR_RGB2BGR)):
        raise OSError(f"{path}: cannot be written. Check the folder and the free space.")
