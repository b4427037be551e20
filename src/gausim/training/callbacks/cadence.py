"""Functions for callbacks: their epochs and the training data."""

from lightning.pytorch import Trainer

from gausim.data.datamodule import ReadyDataModule


def has_come(trainer: Trainer, every: int) -> bool:
    """Whether the epoch that ends is a multiple of ``every`` or the last one; ``every`` 0 is never."""
    epoch = trainer.current_epoch + 1
    return every > 0 and (trainer.should_stop or epoch == trainer.max_epochs or epoch % every == 0)


def training_data(trainer: Trainer) -> ReadyDataModule:
    """The trainer's data module."""
    data = getattr(trainer, "datamodule", None)
    assert isinstance(data, ReadyDataModule)
    return data
