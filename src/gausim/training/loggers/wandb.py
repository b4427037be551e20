"""Weights & Biases: one run there per run directory, whatever happens to the process that trains."""

from __future__ import annotations

import shutil
import uuid
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from gausim.core import RunError
from gausim.io.files import write_durably
from gausim.runs.names import WANDB_ID
from gausim.runs.randomness import undisturbed
from gausim.training.loggers.files import CsvLog
from gausim.training.loggers.media import Media, media_of

# Seconds after which a server that does not answer is given up.
_PATIENCE = 30.0


class WandbLog(Logger):
    """Weights & Biases, offline by default; a resumed run continues under the id kept in ``wandb_id``.

    ``wandb sync`` lets one offline part of a run replace another. So a resumed run logs again what the run logged up to
    its checkpoint (kept in ``wandb/metrics.csv`` and ``panels/``) and removes the earlier part: what lies in the
    directory is always one part, and whole.
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
        """Keeps the settings; nothing is begun before the first number.

        Args:
            save_dir: the run directory.
            project: where runs are collected.
            group: what the run is listed under.
            name: what it is called.
            tags: further words to find it by.
            offline: write to ``save_dir/wandb`` only, for ``wandb sync``; else needs a network and a key
                (``WANDB_API_KEY``, or ``wandb login`` once).
        """
        super().__init__()
        self._folder, self._offline = Path(save_dir), offline
        self._settings: dict[str, Any] = {"project": project, "group": group, "name": name, "tags": list(tags)}
        self._config: dict[str, Any] = {}
        self._rows = CsvLog(save_dir, name="wandb")
        self._run: Any = None
        self._open = False

    @property
    def name(self) -> str | None:
        """The project."""
        return str(self._settings["project"])

    @property
    def version(self) -> str:
        """The run's id, made at the first use."""
        return _own_id(self._folder / WANDB_ID)

    @rank_zero_only
    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Keeps the configuration for the begin of the run."""
        self._config = dict(vars(params) if isinstance(params, Namespace) else params)

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Logs numbers of a step."""
        self._begin()
        self._rows.log_metrics(metrics, step)
        self._log(metrics, step or 0)

    @rank_zero_only
    def log_media(self, media: Media) -> None:
        """Shows the media of one step."""
        self._begin()
        self._show(media)

    @rank_zero_only
    def resume_at(self, step: int) -> None:
        """Begins, and logs again what the run has logged up to ``step``, as far as it is not there."""
        self._rows.resume_at(step)
        # Numbers and media of one step make one row there, and steps must come in their order.
        entries: list[tuple[int, Any]] = [*self._rows.rows(), *((m.step, m) for m in media_of(self._folder))]
        self._begin()
        for at, entry in sorted(entries, key=lambda pair: pair[0]):
            if at <= step:
                self._show(entry) if isinstance(entry, Media) else self._log(entry, at)
        self.save()
        if self._offline:
            self._remove_earlier_parts()

    @rank_zero_only
    def save(self) -> None:
        """Closes the row of the latest step, so that it is kept whatever happens to this process."""
        if self._run is not None and self._open:
            self._run.log({}, commit=True)
            self._open = False

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Ends the run, once."""
        run, self._run = self._run, None
        if run is not None:
            with undisturbed():
                run.finish(exit_code=int(status == "failed"))

    def _begin(self) -> None:
        if self._run is not None:
            return
        import wandb

        with undisturbed():
            try:
                self._run = wandb.init(
                    **self._settings,
                    id=self.version,
                    dir=str(self._folder),
                    mode="offline" if self._offline else "online",
                    resume=None if self._offline else "allow",
                    job_type="train",
                    config=self._config,
                    reinit="create_new",  # a sweep has several runs in one process; none is the process's own
                    settings=wandb.Settings(console="off", silent=True, init_timeout=_PATIENCE),
                )
            except wandb.Error as error:
                raise RunError(
                    f"logger.wandb: cannot begin an online run ({error}). Set WANDB_API_KEY or call `wandb login`, "
                    "check the network, or log offline (logger.wandb.offline=true) and call `wandb sync` later."
                ) from error

    def _log(self, values: Mapping[str, Any], step: int) -> None:
        # The server has steps that a resumed run does again; it refuses them.
        if step >= self._run.starting_step:
            with undisturbed():
                self._run.log(dict(values), step=step)
            self._open = True

    def _show(self, media: Media) -> None:
        with undisturbed():
            shown = self._shown(media)
        self._log(shown, media.step)

    @staticmethod
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
                xs=list(frames),
                ys=[list(s) for s in series],
                keys=columns[1:],
                title=f"{name}: l2 x1000",
                xname="frame",
            )
        columns, rows = media.objects()
        shown["media/objects"] = wandb.Table(columns=list[str | int](columns), data=rows)
        return shown

    def _remove_earlier_parts(self) -> None:
        own = Path(self._run.dir).parent.resolve()
        for folder in (self._folder / "wandb").glob(f"offline-run-*-{self.version}"):
            if folder.resolve() != own:
                shutil.rmtree(folder, ignore_errors=True)


def _own_id(path: Path) -> str:
    if not path.is_file():
        write_durably(path, uuid.uuid4().hex[:12].encode())
    return path.read_text()
