"""What callbacks share: when they act, and the data that they look at."""

from __future__ import annotations

from lightning.pytorch import Trainer

from gausim.data.datamodule import ReadyDataModule


def has_come(trainer: Trainer, every: int) -> bool:
    """At the end of an epoch: whether it is one of every so many, or the last one; ``every`` 0 is never."""
    epoch = trainer.current_epoch + 1
    return every > 0 and (trainer.should_stop or epoch == trainer.max_epochs or epoch % every == 0)


def training_data(trainer: Trainer) -> ReadyDataModule:
    """What the trainer was given to train on."""
    data = getattr(trainer, "datamodule", None)
    assert isinstance(data, ReadyDataModule)
    return data
