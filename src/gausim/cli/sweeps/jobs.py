"""Jobs of a sweep: what each does about a run that is there already, how they are launched, and the summary."""

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

from gausim.core.errors import BusyError, GausSimError, RunError
from gausim.runs.directory import RunDirectory, one_line

log = logging.getLogger(__name__)

# What became of a job.
TRAINED, PRUNED, FINISHED_BEFORE, BUSY = "trained", "pruned", "finished before", "trained by another process"
FAILED, FAILED_BEFORE = "failed", "failed before"
# The metric that searches minimise: the last epoch's loss above the floor, as a fraction of the static prediction's.
OBJECTIVE = "excess_static"


class JobResult(float):
    """The objective of a job, which any sweeper can read (nan where there is none), and what became of the job.

    Attributes:
        state: one of the constants of this module.
        directory: its run directory.
        detail: the error, of one that failed.
    """

    state: str
    directory: str
    detail: str

    @classmethod
    def of(cls, objective: float | None, state: str, run: RunDirectory, detail: str = "") -> JobResult:
        """Puts the two together."""
        result = cls(math.nan if objective is None else objective)
        result.state, result.directory, result.detail = state, str(run.path), detail
        return result


def do_job(cfg: DictConfig, run: RunDirectory, train: Callable[[DictConfig, RunDirectory], Any]) -> JobResult:
    """Does one job of a sweep, unless its run is finished, has failed, or is another process's.

    Args:
        cfg: the job's configuration.
        run: its directory.
        train: trains the run to its end, from its last checkpoint where there is one, and evaluates it if asked to.

    Returns:
        What became of it. No error is raised, so that the other jobs go on.
    """
    try:
        with run.writing():
            left_out = _left_out(cfg, run)
            if left_out is not None:
                return left_out
            objective = train(cfg, run)
            # Of several ranks that a scheduler started, only the first has surely written the marker by now.
            return _finished(run, TRAINED) if run.is_finished else JobResult.of(objective, TRAINED, run)
    except BusyError as error:
        print(f"left out, {error}", flush=True)
        return JobResult.of(None, BUSY, run)
    except Exception as error:
        # The traceback of a defect goes to the job's log; an error meant for people explains itself.
        log.error("%s: %s", run.path, one_line(error), exc_info=not isinstance(error, GausSimError))
        return JobResult.of(None, FAILED, run, one_line(error))


def _left_out(cfg: DictConfig, run: RunDirectory) -> JobResult | None:
    """The result of a run that is not to be trained (again)."""
    if cfg.overwrite:
        return None
    if run.is_finished:
        config = cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True))
        run.check_unchanged(config)
        if cfg.evaluate and run.awaits_evaluation(config):
            return None
        print(f"left out, finished before: {run.path}", flush=True)
        return _finished(run, FINISHED_BEFORE)
    if run.has_failed and not cfg.sweep.retry_failed:
        print(f"left out, failed before (sweep.retry_failed=true tries again): {run.path}", flush=True)
        return JobResult.of(None, FAILED_BEFORE, run, run.failure())
    return None


def _finished(run: RunDirectory, state: str) -> JobResult:
    facts = run.facts()
    return JobResult.of(facts["last_epoch"].get(OBJECTIVE), PRUNED if facts.get("pruned") else state, run)


@contextmanager
def launching(folder: Path) -> Iterator[None]:
    """The block in which jobs run: what is no fault of the configuration is the launcher's."""
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
    """What became of a job that a launcher has run; raises what ended it outside our hands."""
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
    told = [f"{counts[s]} {s}" for s in (TRAINED, PRUNED, FINISHED_BEFORE, BUSY) if counts[s]]
    failed = {r.directory: r for r in results if r.state in (FAILED, FAILED_BEFORE)}
    told += [f"{len(failed)} failed"] if failed else []
    shown = ", ".join(told) or "nothing left to do"
    print(f"\nsweep of {len(results)} jobs: {shown}\nnext: gausim report {folder}", flush=True)
    if failed:
        lines = [f"\n  {r.directory}: {r.detail}" for r in failed.values()]
        raise RunError(
            f"{len(failed)} of {len(results)} jobs failed:{''.join(lines)}\n"
            "The same command with sweep.retry_failed=true tries these again, from their last checkpoints."
        )
