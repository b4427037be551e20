"""The sweeper for Hydra, which searches this namespace. Every Hydra program loads this file, so it imports lazily."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper


class GridSweeper(BasicSweeper):
    """Hydra's grid of all combinations with a summary of all jobs (`hydra/sweeper=grid`).

    A killed sweep can be continued: jobs skip finished runs and resume unfinished ones.
    """

    def __init__(self, max_batch_size: int | None = None, params: dict[str, str] | None = None) -> None:
        """Stores the settings, documented in conf/hydra/sweeper/grid.yaml."""
        super().__init__(max_batch_size, params)

    def validate_batch_is_legal(self, batch: Sequence[Sequence[str]]) -> None:
        """Does nothing: all jobs were checked before the sweep (:func:`gausim.compose.command.run_hydra`)."""

    def sweep(self, arguments: list[str]) -> None:
        """Trains all combinations of the overrides and prints a summary of the jobs.

        Raises:
            ConfigError: an override has no value.
            RunError: a job failed.
        """
        from gausim.cli.sweeps.jobs import conclude, launching
        from gausim.core.errors import ConfigError

        assert self.config is not None
        folder = Path(str(self.config.hydra.sweep.dir))
        with launching(folder):
            batches: Any = super().sweep(arguments)
            jobs = [job for batch in batches for job in batch]
            if not jobs:
                raise ConfigError(
                    f"{' '.join(arguments)}: expected at least one value of every key, so there is nothing to run."
                )
            conclude(folder, jobs)
