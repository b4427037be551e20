"""The stages before the first optimiser step: track, warm start, teach. The rollouts on images follow."""

import torch
from torch import Tensor

from gausim.core import ConfigError
from gausim.data.datamodule import ReadyDataModule
from gausim.models.step.simulator import GausSim
from gausim.training.learner import Learner
from gausim.training.plan import TrainingPlan
from gausim.training.teach import teach
from gausim.training.tracking import track
from gausim.training.warm_start import warm_start


def begin(learner: Learner, data: ReadyDataModule, plan: TrainingPlan, *, seed: int, quiet: bool = False) -> None:
    """Makes the stages that the plan has, on the first rank for all.

    They draw from generators of their own, and leave no state but the weights: a run that is interrupted within them
    starts again and finds the same.

    Raises:
        ConfigError: the model is none of the simulators.
    """
    if plan.warm_start is None and plan.teach is None:
        return
    model = learner.model
    if not isinstance(model, GausSim):
        raise ConfigError("plan: expected a simulator for warm_start and teach. Set both to null.")

    def made() -> dict[str, Tensor]:
        tracks = track(learner, data, quiet=quiet)
        if plan.warm_start is not None:
            warm_start(learner, tracks, plan.warm_start, quiet=quiet)
        if plan.teach is not None:
            teach(learner, model, tracks, plan.teach, seed=seed, quiet=quiet, fitted=plan.warm_start is not None)
        return {name: value.detach().cpu() for name, value in learner.state_dict().items()}

    own = learner.state_dict()
    with torch.no_grad():
        for name, value in learner.ranks.first(made).items():
            own[name].copy_(value)
