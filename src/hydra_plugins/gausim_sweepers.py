"""Hydra finds sweepers in this namespace only. Every Hydra program loads this file, so the work is in `gausim.cli`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.plugins.sweeper import Sweeper

if TYPE_CHECKING:
    from hydra.types import HydraContext, TaskFunction
    from omegaconf import DictConfig

    from gausim.cli.sweeps.grid import Sweep


class GridSweeper(BasicSweeper):
    """Hydra's grid of all combinations, whose summary tells what became of each job (`hydra/sweeper=grid`).

    It goes on where it was killed, as every job leaves out a run that is finished and resumes one that is not.
    """

    def __init__(self, max_batch_size: int | None = None, params: dict[str, str] | None = None) -> None:
        """Keeps the settings.

        Args:
            max_batch_size: most jobs that are handed to the launcher at a time; None hands over all.
            params: what is swept, key to comma-separated values, beside the command line.
        """
        super().__init__(max_batch_size, params)

    def _parse_config(self) -> list[str]:
        from gausim.compose.places import spelled

        return spelled(super()._parse_config())

    def sweep(self, arguments: list[str]) -> None:
        """Trains what the overrides ask for."""
        from pathlib import Path

        from gausim.cli.sweeps.grid import run_grid

        assert self.config is not None
        run_grid(super().sweep, arguments, Path(str(self.config.hydra.sweep.dir)))


class OptunaSweeper(Sweeper):
    """A search by Optuna that goes on where it was killed (`hydra/sweeper=optuna`)."""

    def __init__(self, **settings: Any) -> None:
        """Keeps the settings; `gausim.cli.sweeps.optuna.SearchSettings` explains them."""
        self._settings = settings
        self._sweep: Sweep | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Builds the launcher."""
        from gausim.cli.sweeps.grid import Sweep

        self.hydra_context, self.config = hydra_context, config
        self._sweep = Sweep(config, hydra_context, task_function)

    def sweep(self, arguments: list[str]) -> None:
        """Trains one trial after another."""
        from gausim.cli.sweeps.optuna import Search, SearchSettings

        assert self._sweep is not None
        Search(self._sweep, SearchSettings(**self._settings)).run(arguments)
