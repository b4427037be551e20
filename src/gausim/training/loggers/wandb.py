"""Weights & Biases logger: one wandb run per run directory, also after interruptions."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import WandbLogger

from gausim.core import RunError
from gausim.io.files import write_durably
from gausim.runs.names import WANDB_ID
from gausim.runs.randomness import undisturbed
from gausim.training.loggers.media import Media, media_of
from gausim.training.table import Table

# Time limit of the server's first answer [s].
_PATIENCE = 30.0


class WandbLog(WandbLogger):
    """Lightning's logger, offline by default; a resumed run continues under the id kept in ``wandb_id``.

    ``wandb sync`` replaces one offline part of a run by another. So a resumed run logs all entries up to its checkpoint
    again (from ``wandb/metrics.csv`` and ``panels/``) and removes the earlier part: the directory always contains one
    complete part. All entries of one optimiser step are one wandb row.
    """

    def __init__(
        self,
        save_dir: str | Path,
        *,
        project: str = "gausim",
        group: str | None = None,
        name: str | None = None,
        tags: Sequence[str] = (),
        offline: bool = True,
    ) -> None:
        """Starts no wandb run before the first metric; ``save_dir`` is the run directory, the rest as in wandb."""
        self._folder, self._local = Path(save_dir), offline
        super().__init__(
            name=name, save_dir=save_dir, project=project, group=group, tags=list(tags),
            mode="offline" if offline else "online", resume=None if offline else "allow", job_type="train",
            reinit="create_new",  # a sweep has several runs in one process
            settings={"console": "off", "silent": True, "init_timeout": _PATIENCE},
        )  # fmt: skip
        self._table = Table(self._folder / "wandb" / "metrics.csv", "step")
        self._row_is_open = False

    @property
    def version(self) -> str:
        """The run's id, created on first use."""
        path = self._folder / WANDB_ID
        if not path.is_file():
            write_durably(path, uuid.uuid4().hex[:12].encode())
        return path.read_text()

    @property
    def experiment(self) -> Any:
        """The wandb run, started on first use; Lightning's property would count log calls as steps.

        Raises:
            RunError: the server does not answer, or refuses.
        """
        if self._experiment is None:
            import wandb

            with undisturbed():
                try:
                    self._experiment = wandb.init(**{**self._wandb_init, "id": self.version})
                except wandb.Error as error:
                    raise RunError(
                        f"logger.wandb: cannot begin an online run ({error}). Set WANDB_API_KEY or call `wandb login`, "
                        "check the network, or log offline (logger.wandb.offline=true) and call `wandb sync` later."
                    ) from error
        return self._experiment

    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """Stores the configuration for the start of the run."""
        self._wandb_init["config"] = dict(params)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Logs metrics of a step."""
        self._table.append({"step": step, **{name: float(value) for name, value in metrics.items()}})
        self._log(metrics, step or 0)

    def log_media(self, media: Media) -> None:
        """Logs the media of one step."""
        with undisturbed():
            shown = _shown(media)
        self._log(shown, media.step)

    def resume_at(self, step: int) -> None:
        """Starts the run, and logs again entries up to ``step`` that the server does not have."""
        self._table.resume_at(step)
        own = self.experiment
        entries: list[tuple[int, Any]] = [(m.step, m) for m in media_of(self._folder) if m.step <= step]
        for row in self._table.rows():
            at = int(row.pop("step") or 0)
            entries.append((at, {name: float(value) for name, value in row.items() if value}))
        # In the order of steps, metrics before media.
        for at, entry in sorted(entries, key=lambda pair: (pair[0], isinstance(pair[1], Media))):
            self.log_media(entry) if isinstance(entry, Media) else self._log(entry, at)
        self.save()
        if self._local:
            part = Path(own.dir).parent.resolve()
            for folder in (self._folder / "wandb").glob(f"offline-run-*-{self.version}"):
                if folder.resolve() != part:
                    shutil.rmtree(folder, ignore_errors=True)

    def save(self) -> None:
        """Writes the row of the latest step, so that it survives an interruption."""
        if self._experiment is not None and self._row_is_open:
            with undisturbed():
                self._experiment.log({}, commit=True)
            self._row_is_open = False

    def finalize(self, status: str) -> None:
        """Ends the run; later calls do nothing."""
        run, self._experiment = self._experiment, None
        if run is not None:
            with undisturbed():
                run.finish(exit_code=int(status == "failed"))

    def _log(self, values: Mapping[str, Any], step: int) -> None:
        # The server refuses steps that it has, which a resumed run repeats.
        if step >= self.experiment.starting_step:
            with undisturbed():
                self.experiment.log(dict(values), step=step)
            self._row_is_open = True


def _shown(media: Media) -> dict[str, Any]:
    import wandb

    shown: dict[str, Any] = {}
    for name in media.names:
        key = f"media/{name}"
        shown[f"{key}/video"] = wandb.Video(str(media.video(name)), format="mp4")
        shown |= {f"{key}/{kind}": wandb.Image(str(path)) for kind, path in media.pictures(name).items()}
        columns, rows = media.errors(name)
        frames, *series = zip(*[[float(v or "nan") for v in row] for row in rows], strict=True)
        shown[f"{key}/errors"] = wandb.plot.line_series(
            xs=list(frames), ys=[list(s) for s in series], keys=columns[1:], title=f"{name}: l2 x1000", xname="frame"
        )
    columns, rows = media.objects()
    shown["media/objects"] = wandb.Table(columns=list[str | int](columns), data=rows)
    return shown
