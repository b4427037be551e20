"""Jobs of a sweep: handling of existing runs, launching, and the summary."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

from hydra.core.utils import JobReturn
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gausim.compose.build import with_resolved_plan
from gausim.core.errors import BusyError, GausSimError, RunError
from gausim.runs.directory import RunDirectory, one_line

log = logging.getLogger(__name__)

# Outcomes of a job.
TRAINED, FINISHED_BEFORE, BUSY = "trained", "finished before", "trained by another process"
FAILED, FAILED_BEFORE = "failed", "failed before"
# The metric that a search may minimise: the last epoch's loss above the floor, over that of the static prediction.
OBJECTIVE = "excess_static"


class JobResult(float):
    """The objective of a job as a float (nan if it has none), with the outcome of the job."""

    state: str  # one of the constants of this module
    directory: str  # the run directory
    detail: str  # the error of a failed job

    @classmethod
    def of(cls, objective: float | None, state: str, run: RunDirectory, detail: str = "") -> JobResult:
        """Makes a result; an objective of None becomes nan."""
        result = cls(math.nan if objective is None else objective)
        result.state, result.directory, result.detail = state, str(run.path), detail
        return result


def do_job(cfg: DictConfig, run: RunDirectory, train: Callable[[DictConfig, RunDirectory], Any]) -> JobResult:
    """Runs one job of a sweep, unless its run is finished, has failed, or is in use by another process.

    ``train`` trains the run to its end and evaluates it if asked to. Errors are not raised, so that other jobs
    continue.
    """
    try:
        with run.writing():
            left_out = _left_out(cfg, run)
            if left_out is not None:
                return left_out
            objective = train(cfg, run)
            # Of several ranks started by a scheduler, only the first has certainly written the marker.
            return _finished(run, TRAINED) if run.is_finished else JobResult.of(objective, TRAINED, run)
    except BusyError as error:
        print(f"left out, {error}", flush=True)
        return JobResult.of(None, BUSY, run)
    except Exception as error:
        # The log of the job gets a traceback, except for errors of gausim, which are self-explanatory.
        log.error("%s: %s", run.path, one_line(error), exc_info=not isinstance(error, GausSimError))
        return JobResult.of(None, FAILED, run, one_line(error))


def _left_out(cfg: DictConfig, run: RunDirectory) -> JobResult | None:
    """The result of a run that is skipped; None if it must be trained."""
    if cfg.overwrite:
        return None
    if run.is_finished:
        config = cast("dict[str, Any]", OmegaConf.to_container(with_resolved_plan(cfg), resolve=True))
        run.check_unchanged(config)
        if cfg.evaluate and run.awaits_evaluation(config):
            return None
        print(f"left out, finished before: {run.path}", flush=True)
        return _finished(run, FINISHED_BEFORE)
    if run.has_failed and not cfg.retry_failed:
        print(f"left out, failed before (retry_failed=true tries again): {run.path}", flush=True)
        return JobResult.of(None, FAILED_BEFORE, run, run.failure())
    return None


def _finished(run: RunDirectory, state: str) -> JobResult:
    facts = run.facts()
    return JobResult.of(facts["last_epoch"].get(OBJECTIVE), state, run)


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


def result_of(returned: JobReturn) -> JobResult:
    """The result of a job that a launcher has run; raises an error from outside :func:`do_job`."""
    value = returned.return_value
    if isinstance(value, JobResult):
        return value
    assert returned.hydra_cfg is not None
    return JobResult.of(value, TRAINED, RunDirectory(returned.hydra_cfg.hydra.runtime.output_dir))


def conclude(folder: Path, results: Sequence[JobResult]) -> None:
    """Prints the summary of a sweep.

    Raises:
        RunError: a job failed, now or before.
    """
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
