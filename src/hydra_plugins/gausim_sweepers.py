"""Hydra finds sweepers in this namespace only. Every Hydra program loads this file, so the work is in `gausim.cli`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper

if TYPE_CHECKING:
    from hydra.types import HydraContext, TaskFunction
    from omegaconf import DictConfig


class GridSweeper(BasicSweeper):
    """Hydra's grid of all combinations, whose summary tells what became of each job (`hydra/sweeper=grid`).

    It goes on where it was killed, as every job leaves out a run that is finished and resumes one that is not.
    """

    def __init__(self, max_batch_size: int | None = None, params: dict[str, str] | None = None) -> None:
        """Keeps the settings, which conf/hydra/sweeper/grid.yaml explains."""
        super().__init__(max_batch_size, params)

    def _parse_config(self) -> list[str]:
        from gausim.compose.places import spelled

        return spelled(super()._parse_config())

    def sweep(self, arguments: list[str]) -> None:
        """Trains what the overrides ask for, and tells what became of the jobs.

        Raises:
            ConfigError: an override gives no value.
            RunError: a job failed.
        """
        from gausim.cli.sweeps.jobs import conclude, launching, result_of
        from gausim.core.errors import ConfigError

        assert self.config is not None
        folder = Path(str(self.config.hydra.sweep.dir))
        with launching(folder):
            batches: Any = super().sweep(arguments)
            results = [result_of(one) for batch in batches for one in batch]
        if not results:
            raise ConfigError(
                f"{' '.join(arguments)}: expected at least one value of every key, so there is nothing to run."
            )
        conclude(folder, results)


class OptunaSweeper(Sweeper):
    """A search by Optuna that goes on where it was killed (`hydra/sweeper=optuna`)."""

    def __init__(self, **settings: Any) -> None:
        """Keeps the settings, which conf/hydra/sweeper/optuna.yaml explains."""
        self._settings = settings

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Builds the launcher."""
        self.hydra_context, self.config = hydra_context, config
        self._launcher = Plugins.instance().instantiate_launcher(hydra_context, task_function, config)

    def sweep(self, arguments: list[str]) -> None:
        """Trains one trial after another."""
        from gausim.cli.sweeps.optuna import Search, SearchSettings

        assert self.config is not None and self.hydra_context is not None
        settings = SearchSettings(**self._settings)
        Search(self.config, self.hydra_context, self._launcher, settings).run(arguments)
