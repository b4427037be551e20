"""Run directories: configuration, progress, and whether a run is finished or can be resumed."""

import json
import os
import platform
import shutil
import traceback
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml
from lightning.pytorch.utilities import rank_zero_only

from gausim.core import GausSimError, RunError
from gausim.io.files import read_yaml, remove_leftovers, write_durably
from gausim.runs.checkpoint import PREVIOUS_CHECKPOINT, read_checkpoint
from gausim.runs.comparison import changed_keys
from gausim.runs.data_print import DATA
from gausim.runs.files import sole_writer, unwritable
from gausim.runs.names import CONFIG, EPOCHS, EVALUATION, FAILED, FINISHED, LAST_CHECKPOINT, MOTION, TEST

LOCK, EVENTS = ".lock", "events.jsonl"
DAMAGED_CHECKPOINT = "last.damaged.ckpt"
# Files that `overwrite` removes; gausim made no others in the directory.
OWN_FILES = (
    CONFIG, FINISHED, FAILED, EVENTS, LAST_CHECKPOINT, PREVIOUS_CHECKPOINT, DAMAGED_CHECKPOINT, EPOCHS,
    MOTION, DATA,
)  # fmt: skip
# Files that Hydra makes before a job starts.
HYDRA_FILES = (".hydra/config.yaml", ".hydra/hydra.yaml", ".hydra/overrides.yaml", "train.log")
OWN_FOLDERS = ("panels", "tensorboard", "csv", "wandb")


class RunDirectory:
    """The directory of exactly one training run."""

    def __init__(self, path: Path | str) -> None:
        """Sets the path; :meth:`prepare` makes the directory."""
        self.path = Path(path)
        self._prepared = self.has_stepped = False

    @property
    def checkpoint(self) -> Path:
        """The last checkpoint."""
        return self.path / LAST_CHECKPOINT

    @property
    def is_finished(self) -> bool:
        """Whether the run is complete."""
        return (self.path / FINISHED).is_file()

    @property
    def has_failed(self) -> bool:
        """Whether an error ended the run, and it was not resumed since."""
        return (self.path / FAILED).is_file()

    def failure(self) -> str:
        """The error that ended a failed run, in one line."""
        lines = (self.path / FAILED).read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "unknown"

    def config(self) -> dict[str, Any]:
        """The resolved configuration of the run.

        Raises:
            RunError: there is no run here, or its configuration is unreadable.
        """
        path = self.path / CONFIG
        if not path.is_file():
            raise RunError(f"{self.path}: no run here ({CONFIG} is missing). Train first (`gausim train name=NAME`).")
        try:
            return dict(read_yaml(path))
        except ValueError as error:
            raise RunError(str(error)) from error

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Context of training: other processes get a BusyError, and errors of the disk become a RunError."""
        try:
            if getattr(rank_zero_only, "rank", 0):  # the first rank locks for all ranks of the run
                yield
                return
            with sole_writer(self.path / LOCK):
                yield
        except OSError as error:
            explained = unwritable(error, self.path)
            if explained is None:
                raise
            raise explained from error

    def prepare(self, config: Mapping[str, Any], *, overwrite: bool = False) -> Path | None:
        """Makes the directory and writes the resolved configuration; returns the checkpoint to resume from, if any.

        ``overwrite`` removes the files of an earlier run.

        Raises:
            RunError: the run is finished, was started with another configuration, or has no intact checkpoint.
        """
        remove_leftovers(self.path)
        if overwrite:
            self._clear()
        if self.is_finished:
            raise RunError(
                f"{self.path}: this run is finished. Give the new one another name (name=NAME) or seed, or remove the "
                "old one with overwrite=true."
            )
        if self.checkpoint_to_resume is not None:
            self.check_unchanged(config)
        resume = self._whole_checkpoint()
        write_durably(self.path / CONFIG, yaml.safe_dump(dict(config), sort_keys=False).encode())
        (self.path / FAILED).unlink(missing_ok=True)
        self.record("resumed" if resume else "started")
        self._prepared = True
        return resume

    @property
    def checkpoint_to_resume(self) -> Path | None:
        """The checkpoint that a prepared run continues from, if any."""
        return next(filter(Path.is_file, (self.checkpoint, self.path / PREVIOUS_CHECKPOINT)), None)

    def check_unchanged(self, config: Mapping[str, Any]) -> None:
        """Compares the configuration of this run with another one.

        Raises:
            RunError: they differ in a key that affects training.
        """
        changed = changed_keys(self.config(), config) if (self.path / CONFIG).is_file() else []
        if changed:
            raise RunError(
                f"{self.path}: the run here was started with another configuration; changed: {', '.join(changed)}. "
                "Restore these keys to resume it, give the new run another name, or set overwrite=true."
            )

    def record(self, event: str) -> None:
        """Adds an event with time and process to the run's history."""
        with (self.path / EVENTS).open("a") as file:
            file.write(json.dumps({"time": _now(), "event": event, **_who()}) + "\n")

    @contextmanager
    def recording_failure(self, root: Path) -> Iterator[None]:
        """Context of training: an error that ends it after :meth:`prepare` is written to ``FAILED``.

        A new run that fails before its first step (``has_stepped``) is removed: its directory, and those above it,
        below ``root``, that are then empty.
        """
        is_new = not (self.path / EVENTS).is_file()
        try:
            yield
        except Exception as error:
            with suppress(OSError):  # the disk may have failed, or holds files that are not ours
                if getattr(rank_zero_only, "rank", 0):
                    pass
                elif is_new and not self.has_stepped:
                    self._remove(root)
                elif self._prepared:
                    self._note(error)
            raise

    def _remove(self, root: Path) -> None:
        self._clear()
        for name in (LOCK, *HYDRA_FILES):
            (self.path / name).unlink(missing_ok=True)
        hydras = (self.path / HYDRA_FILES[0]).parent
        above = [folder for folder in self.path.resolve().parents if folder.is_relative_to(root.resolve())]
        for folder in (*[hydras] * hydras.is_dir(), self.path, *above):
            folder.rmdir()

    def _note(self, error: Exception) -> None:
        # Errors of gausim are self-explanatory; others get a traceback. The last line is the error itself.
        trace = "" if isinstance(error, GausSimError) else "".join(traceback.format_exception(error)) + "\n"
        head = "".join(f"{key}: {value}\n" for key, value in {"time": _now(), **_who()}.items())
        write_durably(self.path / FAILED, f"{head}\n{trace}{one_line(error)}\n".encode())
        self.record("failed")

    def _whole_checkpoint(self) -> Path | None:
        """The last checkpoint, or the one before it if the last is damaged (which is then renamed)."""
        problems: list[str] = []
        for path in filter(Path.is_file, (self.checkpoint, self.path / PREVIOUS_CHECKPOINT)):
            try:
                read_checkpoint(path)
            except RunError as error:
                problems.append(str(error))
                continue
            if problems:
                aside = self.path / DAMAGED_CHECKPOINT
                os.replace(self.checkpoint, aside)
                warnings.warn(
                    f"{problems[0]} Resuming from {path}, the checkpoint before it; the damaged file is now {aside}.",
                    stacklevel=3,
                )
            return path
        if problems:
            raise RunError(
                f"{self.path}: no checkpoint here is whole. {' '.join(problems)} Train anew (overwrite=true), "
                "or under another name."
            )
        return None

    def awaits_evaluation(self, config: Mapping[str, Any]) -> bool:
        """Whether a run of equal configuration is finished here, but not evaluated (on the part of its data)."""
        finished, measured = self.path / FINISHED, self.path / EVALUATION
        if config["data"].get("part") == "test":
            measured = self.path / TEST
        if not self.is_finished or changed_keys(self.config(), config):
            return False
        return not measured.is_file() or measured.stat().st_mtime < finished.stat().st_mtime

    def finish(self, facts: Mapping[str, Any]) -> None:
        """Marks the run as finished and stores facts about it."""
        write_durably(self.path / FINISHED, (json.dumps(dict(facts), indent=1) + "\n").encode())
        self.record("finished")

    def _clear(self) -> None:
        for name in OWN_FILES:
            (self.path / name).unlink(missing_ok=True)
        for name in OWN_FOLDERS:
            if (self.path / name).is_dir():
                shutil.rmtree(self.path / name)


def one_line(error: BaseException) -> str:
    """An error's type and message in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def _who() -> dict[str, Any]:
    return {"host": platform.node(), "process": os.getpid()}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
