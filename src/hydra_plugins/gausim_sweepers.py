"""Sweepers for Hydra, which searches this namespace. Every Hydra program loads this file, so it imports lazily."""

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
    """Hydra's grid of all combinations with a summary of all jobs (`hydra/sweeper=grid`).

    A killed sweep can be continued: jobs skip finished runs and resume unfinished ones.
    """

    def __init__(self, max_batch_size: int | None = None, params: dict[str, str] | None = None) -> None:
        """Stores the settings, documented in conf/hydra/sweeper/grid.yaml."""
        super().__init__(max_batch_size, params)

    def _parse_config(self) -> list[str]:
        from gausim.compose.places import spelled

        return spelled(super()._parse_config())

    def sweep(self, arguments: list[str]) -> None:
        """Trains all combinations of the overrides and prints a summary of the jobs.

        Raises:
            ConfigError: an override has no value.
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
    """A search by Optuna that can be continued after a kill (`hydra/sweeper=optuna`)."""

    def __init__(self, **settings: Any) -> None:
        """Stores the settings, documented in conf/hydra/sweeper/optuna.yaml."""
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
