"""MLflow: one run there per run directory, whatever happens to the process that trains."""

from __future__ import annotations

import importlib.util
import math
import tempfile
import warnings
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from gausim.core import ConfigError
from gausim.io.files import write_durably
from gausim.runs.names import MLFLOW_ID
from gausim.runs.randomness import undisturbed
from gausim.training.loggers.files import error_plot
from gausim.training.loggers.media import Media

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

# What MLflow takes of parameters.
_PARAMS_AT_ONCE, _LONGEST_PARAM = 100, 6000


class MlflowLog(Logger):
    """MLflow with its tables in one SQLite file; a resumed run continues under the id kept in ``mlflow_id``."""

    def __init__(
        self, save_dir: str | Path, *, database: str | Path, experiment: str = "gausim", name: str | None = None
    ) -> None:
        """Keeps the settings; nothing is begun before the first number.

        Args:
            save_dir: the run directory.
            database: SQLite file of all runs; media go to a folder ``mlflow_artifacts`` beside it.
            experiment: what the run is listed under.
            name: what it is called.

        Raises:
            ConfigError: MLflow is not installed.
        """
        super().__init__()
        if importlib.util.find_spec("mlflow") is None:
            raise ConfigError("logger.mlflow: MLflow is not installed. Call `pip install 'gausim[mlflow]'`.")
        self._folder, self._database = Path(save_dir), Path(database).resolve()
        self._experiment, self._name = experiment, name
        self._config: dict[str, Any] = {}
        self._client: MlflowClient | None = None
        self._id = ""
        self._known: dict[str, int] = {}

    @property
    def name(self) -> str:
        """The experiment."""
        return self._experiment

    @property
    def version(self) -> str:
        """The run's id; empty before the first number of a new run."""
        path = self._folder / MLFLOW_ID
        return path.read_text() if path.is_file() else ""

    @rank_zero_only
    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Keeps the configuration for the begin of the run."""
        self._config = dict(vars(params) if isinstance(params, Namespace) else params)

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Logs numbers of a step, those aside that the run has: MLflow forgets nothing, and keeps both."""
        from mlflow.entities import Metric
        from mlflow.utils.time import get_current_time_millis

        client, now, at = self._begin(), get_current_time_millis(), step or 0
        new = {k: float(v) for k, v in metrics.items() if at > self._known.get(_key(k), -1) and math.isfinite(v)}
        client.log_batch(self._id, metrics=[Metric(_key(k), v, now, at) for k, v in new.items()])

    @rank_zero_only
    def log_media(self, media: Media) -> None:
        """Keeps the media of one step as artifacts."""
        client = self._begin()
        place = f"media/{media.folder.name}"
        client.log_artifacts(self._id, str(media.folder), place)
        for name in media.names:
            with undisturbed():
                self._bytes(f"{name}.errors.png", error_plot(media, name), place)

    @rank_zero_only
    def resume_at(self, step: int) -> None:
        """Begins, and looks up what the run has of every number."""
        client = self._begin()
        for key in client.get_run(self._id).data.metrics:
            self._known[key] = max(metric.step for metric in client.get_metric_history(self._id, key))

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Ends the run, once."""
        client, self._client = self._client, None
        if client is not None:
            client.set_terminated(self._id, "FAILED" if status == "failed" else "FINISHED")

    def _begin(self) -> MlflowClient:
        if self._client is None:
            with undisturbed():
                self._client = self._open()
        return self._client

    def _open(self) -> MlflowClient:
        from mlflow.entities import Param
        from mlflow.exceptions import MlflowException
        from mlflow.tracking import MlflowClient

        self._database.parent.mkdir(parents=True, exist_ok=True)
        client = MlflowClient(f"sqlite:///{self._database}")
        self._id = self.version
        if self._id:
            try:
                client.update_run(self._id, status="RUNNING")
                return client
            except MlflowException as error:
                warnings.warn(
                    f"{self._database}: has no run {self._id} of {self._folder} ({error}); a new one begins.",
                    stacklevel=2,
                )
        run = client.create_run(self._experiment_id(client), run_name=self._name)
        self._id = run.info.run_id
        write_durably(self._folder / MLFLOW_ID, self._id.encode())
        params = [Param(_key(key), value[:_LONGEST_PARAM]) for key, value in _flat(self._config)]
        for start in range(0, len(params), _PARAMS_AT_ONCE):
            client.log_batch(self._id, params=params[start : start + _PARAMS_AT_ONCE])
        client.log_text(self._id, yaml.safe_dump(self._config, sort_keys=False), "config.yaml")
        client.set_tag(self._id, "run_directory", str(self._folder))
        return client

    def _experiment_id(self, client: MlflowClient) -> str:
        from mlflow.exceptions import MlflowException

        known = client.get_experiment_by_name(self._experiment)
        if known is None:
            try:
                artifacts = self._database.parent / "mlflow_artifacts"
                return client.create_experiment(self._experiment, artifact_location=artifacts.as_uri())
            except MlflowException:  # another job of a sweep was faster
                known = client.get_experiment_by_name(self._experiment)
                if known is None:
                    raise
        return known.experiment_id

    def _bytes(self, name: str, content: bytes, place: str) -> None:
        assert self._client is not None
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(content)
            self._client.log_artifact(self._id, str(path), place)


def _key(name: str) -> str:
    """A name that MLflow takes."""
    return "".join(c if c.isalnum() or c in "_-./ " else "_" for c in name)


def _flat(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    if isinstance(value, Mapping) and value:
        return [item for k, v in value.items() for item in _flat(v, f"{prefix}.{k}" if prefix else str(k))]
    return [(prefix, str(value))]
