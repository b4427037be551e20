"""Training as `gausim train` and `gausim adapt` do it: a run or a job of a sweep, its evaluation, and its result."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from gausim.cli.output import end
from gausim.cli.sweeps.jobs import do_job
from gausim.compose.build import is_pretrained, open_data, with_resolved_plan
from gausim.compose.command import run_dir
from gausim.compose.root import in_sweep
from gausim.compose.targets import check_seed
from gausim.compose.train import is_first, plain
from gausim.compose.train import train as train_run_directory
from gausim.core import RunError
from gausim.doctor.examine import examine
from gausim.doctor.text import findings_text
from gausim.runs.directory import RunDirectory


def train(cfg: DictConfig) -> float | None:
    """Trains one run; returns its last loss above the floor as a fraction of the static prediction's.

    In a sweep errors do not stop the other jobs: they are logged and repeated in the summary at the end.

    Raises:
        GausSimError: the run is finished, has another configuration, is damaged or in use, or training diverged.
    """
    run = RunDirectory(run_dir())
    if in_sweep():
        return do_job(cfg, run, train_run)
    with run.writing():
        return train_run(cfg, run)


def train_run(cfg: DictConfig, run: RunDirectory) -> float | None:
    """Trains into a run directory locked by this process, and evaluates the run if configured."""
    check_seed(cfg.seed)
    with run.leaving_no_trace(Path(cfg.output_root)):
        cfg = with_resolved_plan(cfg)
        if cfg.evaluate and not cfg.overwrite and run.awaits_evaluation(plain(cfg)):
            facts = run.facts()
        else:
            facts = _trained(cfg, run)
    if cfg.evaluate:
        _evaluate(run)
    return dict(facts.get("last_epoch", {})).get("excess_static")


def _trained(cfg: DictConfig, run: RunDirectory) -> dict[str, Any]:
    """Trains the run and prints its result; returns its facts."""
    faults = _warn_of_data(cfg) if cfg.doctor and not in_sweep() and is_first() else []
    facts = train_run_directory(cfg, run)
    if is_first():
        if faults:
            facts["data_faults"] = faults
            run.finish(facts)
        commands = [] if cfg.evaluate or is_pretrained(run.path) else [["evaluate", run.path], ["report", run.path]]
        end(_result(facts), "run", run.path, *commands)
    return facts


def _evaluate(run: RunDirectory) -> None:
    """`gausim evaluate RUN` in a separate process, so that it measures time and memory of predictions alone."""
    if not is_first():
        return
    part = run.config()["data"].get("part")
    command = [sys.executable, "-m", "gausim.cli.main", "evaluate", str(run.path), *["--test"] * (part == "test")]
    status = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())}).returncode
    if status:
        raise RunError(
            f"{run.path}: trained, but its evaluation failed with exit status {status} (its message stands above). "
            "Give the same command again to evaluate it, or use `gausim evaluate`."
        )


def _result(facts: dict[str, Any]) -> list[str]:
    """Sentences on the training time, the error on training frames and whether it falls, and faults of the data."""
    more = [
        f"The data are faulty, and so is what it learned from them. {fault} Mend that and train again: "
        "`gausim doctor ROOT` has the remedy."
        for fault in facts.get("data_faults", ())
    ]
    excess = facts["last_epoch"].get("excess_static")
    begin = f"Trained for {facts['epochs']} epochs ({facts['optimizer_steps']} steps)"
    if excess is None or excess < -1:  # the motion is smaller than the error of the reconstruction
        return [f"{begin}.", *more]
    falls = {True: " and still falls", False: " and has stopped falling", None: ""}[facts.get("still_falls")]
    return [
        f"{begin}: on training frames, the loss beyond the reconstruction's is {100 * excess:.0f} % of the static "
        f"prediction's{falls}.",
        *more,
    ]


def _warn_of_data(cfg: DictConfig) -> list[str]:
    """Prints faults and warnings of `gausim doctor` on the objects; returns one sentence per fault."""
    faults: list[str] = []
    for item in open_data(cfg).objects:
        found = examine(item, item.scene()).graver
        if found.findings:
            print(findings_text(str(item.root), found), flush=True)
        faults += [f"{item.name}: {finding.what}" for finding in found.findings if finding.severity == "fault"]
    return faults
