"""Early end of a run by an outside decision, as a search makes for poor trials."""

from __future__ import annotations

from collections.abc import Callable

from lightning.pytorch import Callback, LightningModule, Trainer

from gausim.training.module import GausSimModule


class EpochJudge(Callback):
    """Calls ``judge`` after each epoch; if it returns True, training ends and the run is finished (``stopped``).

    Its arguments are the number of epochs done and the mean of the metric (a column of ``epochs.csv``) over the last.
    """

    def __init__(self, *, judge: Callable[[int, float], bool], metric: str) -> None:
        self._judge, self._metric, self.stopped = judge, metric, False

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Calls the judge; the checkpoint saved afterwards contains the decision."""
        assert isinstance(pl_module, GausSimModule)
        value = pl_module.epoch_means().get(self._metric)
        if value is not None and self._judge(trainer.current_epoch + 1, value):
            self.stopped = trainer.should_stop = True

    def state_dict(self) -> dict[str, bool]:
        """Whether the judge ended training."""
        return {"stopped": self.stopped}

    def load_state_dict(self, state_dict: dict[str, bool]) -> None:
        """Restores the decision."""
        self.stopped = bool(state_dict["stopped"])
