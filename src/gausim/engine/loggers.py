"""Loggers that go on where a resumed run goes on: no row twice, none lost up to the checkpoint."""

from __future__ import annotations

import csv
import io
import uuid
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from gausim.engine.files import write_durably

if TYPE_CHECKING:
    from lightning.pytorch.loggers import WandbLogger

WANDB_ID = "wandb_id"


@runtime_checkable
class Resumable(Protocol):
    """A logger that can forget what was logged after a step."""

    def resume_at(self, step: int) -> None:
        """Drops what was logged for later optimiser steps than ``step``; 0 is a new run."""
        ...


class CsvLog(Logger):
    """One table ``metrics.csv``; a row is on the disk as soon as it is logged."""

    def __init__(self, save_dir: str | Path, *, name: str = "csv") -> None:
        """The table goes to ``save_dir/name``."""
        super().__init__()
        self._name = name
        self.path = Path(save_dir) / name / "metrics.csv"
        self._columns: list[str] = []

    @property
    def name(self) -> str:
        """The folder's name."""
        return self._name

    @property
    def version(self) -> str:
        """None: a run has one table."""
        return ""

    @rank_zero_only
    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Nothing: the run directory holds its configuration."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Writes one row; columns not seen before are added to the table."""
        row: dict[str, Any] = {"step": step, **{name: float(value) for name, value in metrics.items()}}
        if set(row) <= set(self._columns) and self.path.is_file():
            with self.path.open("a", newline="") as file:
                csv.DictWriter(file, self._columns).writerow(row)
        else:
            self._rewrite([*self._rows(), row])

    @rank_zero_only
    def resume_at(self, step: int) -> None:
        """Drops the rows of later steps, and a row that was cut while it was written."""
        if self.path.is_file():
            whole = [row for row in self._rows() if None not in row and None not in row.values()]
            self._rewrite([row for row in whole if int(row["step"] or 0) <= step])

    def _rows(self) -> list[dict[str, Any]]:
        if not self.path.is_file():
            return []
        with self.path.open(newline="") as file:
            return list(csv.DictReader(file))

    def _rewrite(self, rows: list[dict[str, Any]]) -> None:
        self._columns = list(dict.fromkeys(["step", *(name for row in rows for name in row)]))
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._columns)
        writer.writeheader()
        writer.writerows(rows)
        write_durably(self.path, text.getvalue().encode())


class TensorBoardLog(TensorBoardLogger):
    """TensorBoard's events in one folder; those of steps that a resumed run does again are marked as void."""

    def __init__(self, save_dir: str | Path, *, name: str = "tensorboard") -> None:
        """The events go to ``save_dir/name``."""
        super().__init__(save_dir, name=name, version="")

    @rank_zero_only
    def resume_at(self, step: int) -> None:
        """Tells TensorBoard to forget what earlier files hold of later steps."""
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog

        restart = Event(step=step + 1, session_log=SessionLog(status=SessionLog.START))
        self.experiment.file_writer.add_event(restart)


def wandb_logger(
    save_dir: str | Path, *, project: str = "gausim", name: str | None = None, offline: bool = True
) -> WandbLogger:
    """Lightning's Weights & Biases logger under one id per run directory, kept there in ``wandb_id``.

    Args:
        save_dir: the run directory.
        project: of Weights & Biases.
        name: what the run is called there.
        offline: write to ``save_dir/wandb`` only; ``wandb sync`` uploads all parts of a resumed run as one.
    """
    from lightning.pytorch.loggers import WandbLogger

    path = Path(save_dir) / WANDB_ID
    if not path.is_file():
        write_durably(path, uuid.uuid4().hex[:12].encode())
    return WandbLogger(
        name=name, save_dir=save_dir, id=path.read_text(), project=project, offline=offline, resume="allow"
    )
