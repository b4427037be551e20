"""The development and the test part of a run's data, in `gausim evaluate` and in evaluations after training."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from gausim.compose.build import LoadedRun
from gausim.compose.predict import run_objects, sequence_of
from gausim.core.errors import ConfigError, DataError
from gausim.data.datamodule import ReadyDataModule
from gausim.results.looks import DEVELOPMENT, TEST_PART, record_look
from gausim.runs.names import TEST
from gausim.runs.provenance import code_provenance


@dataclass(frozen=True)
class Chosen:
    """Sequences to evaluate."""

    part: str | None  # ``development`` or ``test``; None where the data declare no test part
    sequences: Mapping[str, list[str]]  # their names by object


def choose(run: LoadedRun, arguments: argparse.Namespace) -> Chosen:
    """The sequences that are asked for, of one part.

    Raises:
        ConfigError: no sequence belongs to the part, or ``--test`` or ``--trials`` does not apply.
        DataError: an object or sequence does not exist, or a sequence belongs to the other part.
    """
    items = run_objects(run, arguments.object)
    declared = any({r.name for r in item.data.sequences} & item.data.test_part for item in items)
    if not declared and (arguments.test or arguments.trials):
        raise ConfigError(
            f"--test, --trials: {run.run_dir} was trained on data without a test part. Leave the options out, or "
            "declare one (field 'test' of dataset.json, or data.test)."
        )
    if arguments.trials and not arguments.test:
        raise ConfigError("--trials: declares the trials before a look at the test part; give --test with it.")
    found = {}
    for item in items:
        names = arguments.sequences or [record.name for record in item.data.sequences]
        own = [sequence_of(item, name).name for name in names]
        fitting = [name for name in own if (name in item.data.test_part) == arguments.test]
        if arguments.sequences and len(fitting) < len(own):
            other = [name for name in own if name not in fitting]
            part, how = ("development", "without") if arguments.test else ("test", "with")
            raise DataError(f"{item.data.root}: {other} belong to the {part} part, which is evaluated {how} --test.")
        if fitting:
            found[item.data.name] = fitting
    if not found:
        raise ConfigError(
            f"{run.run_dir}: every sequence of it belongs to the test part. When all decisions are made, look with "
            f"`gausim evaluate {run.run_dir} --test --trials N`, N: the trials made on the development part."
            if not arguments.test
            else f"{run.run_dir}: no sequence of the chosen objects belongs to the test part. Leave --test out."
        )
    return Chosen((TEST_PART if arguments.test else DEVELOPMENT) if declared else None, found)


def look(run: LoadedRun, arguments: argparse.Namespace, chosen: Chosen, state: Mapping[str, Any]) -> dict[str, Any]:
    """Records a look at the test part; returns what the summary says of it.

    Raises:
        ConfigError: the number of trials is not declared.
    """
    trials = arguments.trials or (run.config.get("protocol") or {}).get("trials")
    if not trials:
        raise ConfigError(
            "--test: expected the number of trials that were made of the method on the development part. Declare it "
            "with --trials N, or train with protocol.trials=N."
        )
    path, development = run.run_dir / TEST, run.run_dir / "evaluation" / "development"
    if not path.is_file():
        _move(run.run_dir / "evaluation", development)
    made = record_look(path, trials=trials, provenance=code_provenance(), state=state, sequences=dict(chosen.sequences))
    again = f", look {made.looks}" if made.looks > 1 else ""
    print(f"test part: {trials} trials declared{again}; recorded in {path}")
    return {"part": chosen.part, "trials": trials, "looks": made.looks}


def home(run_dir: Path, part: str | None) -> Path:
    """Folder of a whole evaluation: that of the development part makes room for the test part once it was looked at."""
    folder = run_dir / "evaluation"
    return folder / DEVELOPMENT if part == DEVELOPMENT and (run_dir / TEST).is_file() else folder


def _move(folder: Path, target: Path) -> None:
    """Moves the files of an earlier evaluation of the development part."""
    if (folder / "metrics.json").is_file():
        target.mkdir(parents=True, exist_ok=True)
        for path in sorted(p for p in folder.iterdir() if p.is_file()):
            path.replace(target / path.name)


def check_protocol(cfg: DictConfig, datamodule: ReadyDataModule) -> None:
    """Raises ConfigError where the evaluation after training could not be made as the protocol demands."""
    protocol = cfg.get("protocol") or {}  # configurations of earlier versions have none
    part, trials = protocol.get("part"), protocol.get("trials")
    if part not in (None, DEVELOPMENT, TEST_PART):
        raise ConfigError(f"protocol.part: expected null, {DEVELOPMENT} or {TEST_PART}, got '{part}'.")
    if not cfg.evaluate or not datamodule.has_videos:
        return
    names = [(item.test_part, record.name) for item in datamodule.objects for record in item.sequences]
    reserved = [name in part_of for part_of, name in names]
    if part == TEST_PART and (not trials or not any(reserved)):
        raise ConfigError(
            f"protocol.part: expected protocol.trials for a look at the test part, got {trials}, and sequences of a "
            f"test part in the data, got {sum(reserved)} of {len(reserved)}."
        )
    if part != TEST_PART and all(reserved):
        raise ConfigError(
            "evaluate: every sequence of the data belongs to the test part. Set protocol.part=test and "
            "protocol.trials=N (trials made on the development part), or evaluate=false."
        )
