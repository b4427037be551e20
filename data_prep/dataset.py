"""Runs the stages from films and photos to a data set, one after the other, as a YAML file lists them.

    work: work/flower                  # every stage writes its result to WORK/STAGE
    stages:
      ingest: {films: takes/flower, sync: auto}
      poses: {images: photos/flower, sequences: "{ingest}"}
      segment: {pictures: "{poses}", backend: onnx, onnx: isnet.onnx}

Keys are the options of ``gausim prepare STAGE`` (films, pictures, scene of select, and root are arguments of its
command); ``true`` is a flag, a list several values. ``{STAGE}`` in a value is the directory of an earlier stage; a text
that names a file or folder beside the configuration becomes its path. A stage that runs twice has a name of its own
each time: ``segment-films`` beside ``segment``. A stage whose result is there already is not run again; what was
interrupted goes on.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_prep.common.command import stage_parser
from gausim.core.errors import ConfigError, GausSimError

# Stages in the order in which they make sense, with the arguments that have no option's name.
STAGES = {
    "ingest": ("films",), "poses": (), "segment": ("pictures",), "reconstruct": ("root",), "select": ("scene",),
    "assemble": ("pictures",), "pack": ("root",),
    **{f"import_{name}": ("root",) for name in ("ready", "springgaus", "pacnerf", "phystwin", "3dgsim", "physdreamer")},
}  # fmt: skip


@dataclass(frozen=True)
class Job:
    """One stage to run."""

    name: str  # what the configuration calls it; its result is the folder of that name
    stage: str  # which one
    arguments: tuple[str, ...]  # of its command, the directory of the result included


def plan(config: Path) -> list[Job]:
    """Reads a configuration.

    Raises:
        ConfigError: it cannot be read, names an unknown stage, refers to a later one, or holds what is no option.
    """
    import yaml

    try:
        data = yaml.safe_load(config.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{config}: cannot be read as YAML ({error}).") from error
    if not isinstance(data, dict) or set(data) != {"work", "stages"} or not isinstance(data["work"], str):
        raise ConfigError(f"{config}: expected the fields 'work' (a directory) and 'stages'.")
    stages = data["stages"]
    if not isinstance(stages, dict) or not stages:
        raise ConfigError(f"{config}: field 'stages' must be a mapping of stages, some of {', '.join(STAGES)}.")
    work, made, jobs = config.parent / data["work"], dict[str, Path](), []
    for name, options in stages.items():
        stage = _stage_of(name, config)
        where = f"{config}: stages.{name}"
        if not isinstance(options, dict):
            raise ConfigError(f"{where}: expected a mapping of options, got {options!r}.")
        out = work / name
        jobs.append(Job(name, stage, (*_arguments(stage, options, made, config.parent, where), "--out", str(out))))
        made[name] = out
    return jobs


def prepare(config: Path, *, force: bool = False) -> int:
    """Runs what a configuration lists; stops at the first stage that fails."""
    jobs = plan(config)
    for number, job in enumerate(jobs, 1):
        print(f"[{number}/{len(jobs)}] {job.name}", flush=True)
        command = importlib.import_module(f"data_prep.{job.stage}")
        status = int(command.main([*job.arguments, *(["--force"] if force else [])]))
        if status:
            print(f"error: stage {job.name} of {config} has failed; the same command goes on from it.", file=sys.stderr)
            return status
    return 0


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("dataset", __doc__, result=False)
    parser.add_argument("config", type=Path, metavar="CONFIG.yaml", help="what to run")
    parser.add_argument("--force", action="store_true", help="replace results of other inputs or settings")
    arguments = parser.parse_args(argv)
    try:
        return prepare(arguments.config, force=arguments.force)
    except GausSimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _stage_of(name: Any, config: Path) -> str:
    """The stage that ``segment`` or ``segment-films`` means."""
    match = re.fullmatch(r"([a-z_0-9]+)(-[A-Za-z0-9_]+)*", name) if isinstance(name, str) else None
    if match is None or match[1] not in STAGES:
        raise ConfigError(
            f"{config}: stages: no stage '{name}'; expected some of {', '.join(STAGES)}, with an addition such as "
            "segment-films where one runs twice."
        )
    return match[1]


def _arguments(stage: str, options: Mapping[str, Any], made: Mapping[str, Path], base: Path, where: str) -> list[str]:
    first, rest = [], []
    for key, value in options.items():
        if not isinstance(key, str):
            raise ConfigError(
                f"{where}: {key!r} is no option's name; YAML takes words such as no, on and 1 for values."
            )
        flag = f"--{key.replace('_', '-')}"
        texts = [_text(v, made, base, f"{where}.{key}") for v in (value if isinstance(value, list) else [value])]
        if key in STAGES[stage]:
            first += texts
        elif value is not False:
            rest += [flag] if value is True else [flag, *texts]
    return [*first, *rest]


def _text(value: Any, made: Mapping[str, Path], base: Path, where: str) -> str:
    """One value as the command line has it; what names a file beside the configuration becomes its path."""
    if not isinstance(value, (str, int, float)):
        raise ConfigError(f"{where}: expected a text, a number, true or a list of these, got {value!r}.")
    text = str(value)
    try:
        filled = text.format_map({name: str(path) for name, path in made.items()})
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise ConfigError(
            f"{where}: {text!r} refers to {error}; stages before this one: {', '.join(made) or 'none'}."
        ) from error
    beside = base / filled
    return str(beside) if filled == text and isinstance(value, str) and text and beside.exists() else filled
