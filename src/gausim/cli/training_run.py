"""Training as `gausim train` and `gausim adapt` do it: a run or a job of a sweep, its evaluation, and its result."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from gausim.cli.output import end
from gausim.compose.build import opened
from gausim.compose.root import in_sweep
from gausim.compose.train import is_first, plain, train
from gausim.core import RunError
from gausim.data.datamodule import ReadyDataModule
from gausim.doctor.examine import examine
from gausim.doctor.text import findings_text
from gausim.runs.directory import RunDirectory

FEW_STEPS = 10  # a time limit that leaves fewer is too short


def train_run(cfg: DictConfig, run: RunDirectory) -> None:
    """Trains into a run directory locked by this process, and evaluates the run if configured."""
    with run.recording_failure(Path(cfg.output_root)):
        job = opened(cfg)
        if not cfg.evaluate or cfg.overwrite or not run.awaits_evaluation(plain(job.config)):
            faults = _warn_of_data(job.data) if cfg.doctor and not in_sweep() and is_first() else []
            facts = train(job, run, notes={"data_faults": faults} if faults else {})
            if is_first():
                commands = [] if cfg.evaluate else [["evaluate", run.path], ["report", run.path]]
                end(_result(facts, job.config.plan), "run", run.path, *commands)
    if cfg.evaluate:
        _evaluate(run)


def _evaluate(run: RunDirectory) -> None:
    """`gausim evaluate RUN` in a separate process, so that it measures time and memory of predictions alone."""
    if not is_first():
        return
    part = run.config()["data"].get("part")
    begin = f"from gausim.runs.processes import end_with; end_with({os.getpid()}); "
    begin += "from gausim.cli.main import main; raise SystemExit(main())"
    command = [sys.executable, "-c", begin, "evaluate", str(run.path), *["--test"] * (part == "test")]
    status = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())}).returncode
    if status:
        raise RunError(
            f"{run.path}: trained, but its evaluation failed with exit status {status} (its message stands above). "
            "Give the same command again to evaluate it, or use `gausim evaluate`."
        )


def _result(facts: dict[str, Any], plan: Mapping[str, Any]) -> list[str]:
    """Sentences on the training time, the error on training frames and whether it falls, and faults of the data."""
    more = [
        f"The data are faulty, and so is what it learned from them. {fault} Mend that and train again: "
        "`gausim doctor ROOT` has the remedy."
        for fault in facts.get("data_faults", ())
    ]
    if plan.get("max_minutes") and facts["epochs"] < (plan.get("epochs") or 0) and facts["optimizer_steps"] < FEW_STEPS:
        more.append(f"Most of plan.max_minutes={plan['max_minutes']:g} went into the start. Raise this limit.")
    excess = facts["last_epoch"].get("excess_static")
    counts = [
        f"{n} {unit}{'s' * (n != 1)}" for n, unit in ((facts["epochs"], "epoch"), (facts["optimizer_steps"], "step"))
    ]
    begin = f"Trained for {counts[0]} ({counts[1]})"
    if excess is None or excess < -1:  # the motion is smaller than the error of the reconstruction
        return [f"{begin}.", *more]
    falls = {True: " and still falls", False: " and has stopped falling", None: ""}[facts.get("still_falls")]
    return [
        f"{begin}: on training frames, the loss beyond the reconstruction's is {100 * excess:.0f} % of the static "
        f"prediction's{falls}.",
        *more,
    ]


def _warn_of_data(data: ReadyDataModule) -> list[str]:
    """Prints faults and warnings of `gausim doctor` on the objects; returns one sentence per fault."""
    faults: list[str] = []
    for item in data.objects:
        found = examine(item, item.scene()).graver
        if found.findings:
            print(findings_text(str(item.root), found), flush=True)
        faults += [f"{item.name}: {finding.what}" for finding in found.findings if finding.severity == "fault"]
    return faults
