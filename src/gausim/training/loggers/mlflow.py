"""MLflow logger: one MLflow run per run directory, also after interruptions."""

from __future__ import annotations

import importlib.util
import math
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from lightning.pytorch.loggers import MLFlowLogger

from gausim.core import ConfigError
from gausim.io.files import write_durably
from gausim.runs.comparison import flatten
from gausim.runs.names import MLFLOW_ID
from gausim.runs.randomness import undisturbed
from gausim.training.loggers.files import error_plot
from gausim.training.loggers.media import Media

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

# MLflow's limits: parameters per call and characters per value.
_PARAMS_AT_ONCE, _LONGEST_PARAM = 100, 6000


class MlflowLog(MLFlowLogger):
    """Lightning's logger with one SQLite file; a resumed run continues under the id kept in ``mlflow_id``."""

    def __init__(
        self, save_dir: str | Path, *, database: str | Path, experiment: str = "gausim", name: str | None = None
    ) -> None:
        """Starts no MLflow run before the first metric.

        ``save_dir`` is the run directory, ``database`` the SQLite file of all runs; media go to a folder
        ``mlflow_artifacts`` beside it.
        """
        if importlib.util.find_spec("mlflow") is None:
            raise ConfigError("logger.mlflow: MLflow is not installed. Call `pip install 'gausim[mlflow]'`.")
        self._folder, path = Path(save_dir), Path(database).resolve()
        path.parent.mkdir(parents=True, exist_ok=True)
        media = (path.parent / "mlflow_artifacts").as_uri()
        with undisturbed():
            super().__init__(experiment, name, f"sqlite:///{path}", artifact_location=media)
        self._config: dict[str, Any] = {}
        self._known: dict[str, int] = {}

    @property
    def experiment(self) -> MlflowClient:
        """MLflow's client, after this run was started or continued."""
        if not self._initialized:
            with undisturbed():
                self._open()
            self._initialized = True
        return self._mlflow_client

    @property
    def version(self) -> str:
        """The run's id; starts the run if necessary."""
        return str(self.run_id)

    def _open(self) -> None:
        from mlflow.entities import Param
        from mlflow.exceptions import MlflowException

        client, id_file = self._mlflow_client, self._folder / MLFLOW_ID
        if id_file.is_file():
            self._run_id = id_file.read_text()
            try:
                client.update_run(self._run_id, status="RUNNING")
                return
            except MlflowException as error:
                self._run_id = None
                warnings.warn(
                    f"{self._tracking_uri}: has no run of {self._folder} ({error}); a new one begins.", stacklevel=2
                )
        try:
            _ = super().experiment
        except MlflowException:  # another job of a sweep created the experiment meanwhile
            _ = super().experiment
        run = self._run_id or ""
        write_durably(id_file, run.encode())
        params = [Param(_key(key), str(value)[:_LONGEST_PARAM]) for key, value in flatten(self._config)]
        for start in range(0, len(params), _PARAMS_AT_ONCE):
            client.log_batch(run, params=params[start : start + _PARAMS_AT_ONCE])
        client.log_text(run, yaml.safe_dump(self._config, sort_keys=False), "config.yaml")
        client.set_tag(run, "run_directory", str(self._folder))

    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """Stores the configuration for the start of the run."""
        self._config = dict(params)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Logs metrics of a step that the run does not have yet: MLflow cannot replace values."""
        new = {_key(k): float(v) for k, v in metrics.items() if math.isfinite(v)}
        super().log_metrics({k: v for k, v in new.items() if (step or 0) > self._known.get(k, -1)}, step)

    def log_media(self, media: Media) -> None:
        """Stores the media of one step as artifacts."""
        place = f"media/{media.folder.name}"
        self.experiment.log_artifacts(self.version, str(media.folder), place)
        for name in media.names:
            with undisturbed(), tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / f"{name}.errors.png"
                path.write_bytes(error_plot(media, name))
                self.experiment.log_artifact(self.version, str(path), place)

    def resume_at(self, step: int) -> None:
        """Starts the run, and reads the last step of every metric that it has."""
        client = self.experiment
        for key in client.get_run(self.version).data.metrics:
            self._known[key] = max(metric.step for metric in client.get_metric_history(self.version, key))

    def finalize(self, status: str = "success") -> None:
        """Ends the run; later calls do nothing."""
        super().finalize(status)
        self._initialized = False


def _key(name: str) -> str:
    """A metric's name in characters that MLflow allows."""
    return "".join(c if c.isalnum() or c in "_-./ " else "_" for c in name)
