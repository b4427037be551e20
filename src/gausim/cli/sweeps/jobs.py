"""Jobs of a sweep: handling of existing runs, launching, and the summary."""

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.utils import JobReturn
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from gausim.compose.build import opened
from gausim.compose.train import plain
from gausim.core.errors import BusyError, GausSimError, RunError
from gausim.runs.directory import RunDirectory, one_line

log = logging.getLogger(__name__)

# Outcomes of a job.
TRAINED, FINISHED_BEFORE, BUSY = "trained", "finished before", "trained by another process"
FAILED, FAILED_BEFORE = "failed", "failed before"


class JobResult(NamedTuple):
    """What became of a job."""

    state: str  # one of the constants of this module
    directory: str  # the run directory
    detail: str = ""  # the error of a failed job


def do_job(cfg: DictConfig, run: RunDirectory, train: Callable[[DictConfig, RunDirectory], Any]) -> JobResult:
    """Runs one job of a sweep, unless its run is finished, has failed, or is in use by another process.

    ``train`` trains the run to its end and evaluates it if asked to. Errors are not raised, so that other jobs
    continue.
    """
    where = str(run.path)
    try:
        with run.writing():
            if not cfg.overwrite and run.is_finished:
                config = plain(opened(cfg).config)
                run.check_unchanged(config)
                if not (cfg.evaluate and run.awaits_evaluation(config)):
                    print(f"left out, finished before: {run.path}", flush=True)
                    return JobResult(FINISHED_BEFORE, where)
            elif not cfg.overwrite and run.has_failed and not cfg.retry_failed:
                print(f"left out, failed before (retry_failed=true tries again): {run.path}", flush=True)
                return JobResult(FAILED_BEFORE, where, run.failure())
            train(cfg, run)
            return JobResult(TRAINED, where)
    except BusyError as error:
        print(f"left out, {error}", flush=True)
        return JobResult(BUSY, where)
    except Exception as error:
        # The log of the job gets a traceback, except for errors of gausim, which are self-explanatory.
        log.error("%s: %s", run.path, one_line(error), exc_info=not isinstance(error, GausSimError))
        return JobResult(FAILED, where, one_line(error))


@contextmanager
def launching(folder: Path) -> Iterator[None]:
    """Context of running jobs: errors other than those of the configuration are attributed to the launcher."""
    try:
        yield
    except (GausSimError, HydraException, OmegaConfBaseException):
        raise
    except Exception as error:
        raise RunError(
            f"{folder}: the launcher stopped ({one_line(error)}). Jobs that it started may still be running. "
            "The same command goes on with what is not finished."
        ) from error


def conclude(folder: Path, jobs: Sequence[JobReturn]) -> None:
    """Prints the summary of a sweep's jobs.

    Raises:
        RunError: a job failed, now or before.
    """
    results: list[JobResult] = [job.return_value for job in jobs]  # raises an error from outside `do_job`
    counts = Counter(result.state for result in results)
    parts = [f"{counts[s]} {s}" for s in (TRAINED, FINISHED_BEFORE, BUSY) if counts[s]]
    failed = {r.directory: r for r in results if r.state in (FAILED, FAILED_BEFORE)}
    parts += [f"{len(failed)} failed"] if failed else []
    shown = ", ".join(parts) or "nothing left to do"
    print(f"\nsweep of {len(results)} jobs: {shown}\nnext: gausim report {folder}", flush=True)
    if failed:
        lines = [f"\n  {r.directory}: {r.detail}" for r in failed.values()]
        raise RunError(
            f"{len(failed)} of {len(results)} jobs failed:{''.join(lines)}\n"
            "The same command with retry_failed=true tries these again, from their last checkpoints."
        )
