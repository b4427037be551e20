"""Ends a run early when somebody else thinks it not worth going on, as a search does with poor trials."""

from __future__ import annotations

from collections.abc import Callable

from lightning.pytorch import Callback, LightningModule, Trainer

from gausim.training.module import GausSimModule


class EpochJudge(Callback):
    """Shows a metric to a judge after each epoch; its word ends training, and the run is then finished (``stopped``).

    The judge takes the number of epochs done and the mean of the metric (a column of ``epochs.csv``) over the last one;
    True ends training.
    """

    def __init__(self, *, judge: Callable[[int, float], bool], metric: str) -> None:
        self._judge, self._metric, self.stopped = judge, metric, False

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Asks. The checkpoint that follows knows of the answer."""
        assert isinstance(pl_module, GausSimModule)
        value = pl_module.epoch_means().get(self._metric)
        if value is not None and self._judge(trainer.current_epoch + 1, value):
            self.stopped = trainer.should_stop = True

    def state_dict(self) -> dict[str, bool]:
        """Whether it ended training."""
        return {"stopped": self.stopped}

    def load_state_dict(self, state_dict: dict[str, bool]) -> None:
        """Remembers it."""
        self.stopped = bool(state_dict["stopped"])
