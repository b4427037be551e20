"""Search for run directories, and their configuration, state and summary, which are read as untrusted data."""

import csv
import hashlib
import json
import os
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import yaml

from gausim.core import RunError
from gausim.io.files import natural, read_yaml
from gausim.results.table import ObjectInfo, Results, load_results
from gausim.runs.choices import dig, hydra_record
from gausim.runs.comparison import flatten
from gausim.runs.names import CONFIG, EPOCHS, EVALUATION, FAILED, FINISHED, HYDRA, LAST_CHECKPOINT

# Files that identify a run whose configuration is unreadable.
_TRACES = (FINISHED, FAILED, EPOCHS, LAST_CHECKPOINT)
_KEYS_OF_A_RUN = {"model", "data", "seed"}
# Keys without an effect on the result, and those of seeds.
_FREE = ("output_root", "logger", "trials", "retry_failed", "evaluate", "seed", "trainer")
INIT_FROM, _SEED_FOLDER = "init_from", re.compile(r"seed_\d+/?$")
_DIGITS = 12  # of hashes and commits
_SWEEP = "multirun.yaml"  # Hydra's record of a sweep

EVALUATED, NOT_EVALUATED, UNFINISHED = "evaluated", "not evaluated", "unfinished"
FAILURE, BROKEN = "failed", "broken files"
NOT_RECORDED = "not recorded"


@dataclass(frozen=True, eq=False)
class RunRecord:
    """One run directory."""

    path: Path
    name: str  # its path below the searched directory
    status: str  # one of the constants above
    detail: str  # explanation of the status, for display
    config: dict[str, Any] = field(default_factory=dict, repr=False)  # empty if unreadable
    choices: dict[str, str] = field(default_factory=dict, repr=False)  # Hydra's, of every config group
    results: Results | None = field(default=None, repr=False)  # content of evaluation/metrics.json
    command: str = NOT_RECORDED  # by which it was trained, of a sweep that of the whole

    @property
    def given_name(self) -> str:
        """The name in its configuration, else that of its folder."""
        return str(self.config.get("name") or self.name)

    @property
    def seed(self) -> Any:
        """The seed of the configuration, or ``?``."""
        return self.config.get("seed", "?")

    @property
    def objects(self) -> dict[str, ObjectInfo]:
        """Facts of its evaluated objects."""
        return self.results.objects if self.results is not None else {}

    @property
    def state(self) -> dict[str, Any]:
        """What was evaluated: epoch and updates of the checkpoint, part of the data, trials and looks."""
        return self.results.run if self.results is not None else {}

    @cached_property
    def settings(self) -> dict[str, str]:
        """Dotted keys and values of the settings that affect the result, without seeds."""
        return self.settings_besides(())

    def settings_besides(self, keys: tuple[str, ...]) -> dict[str, str]:
        """The settings without those of the groups ``keys``."""
        flat = flatten(self.config)
        found = {k: str(v) for k, v in flat if not any(k == f or k.startswith(f"{f}.") for f in (*_FREE, *keys))}
        if INIT_FROM in found:  # the seed of the run that it started from
            found[INIT_FROM] = _SEED_FOLDER.sub("seed_*", found[INIT_FROM])
        return found

    @property
    def config_hash(self) -> str:
        """First twelve digits of the SHA-256 of the whole configuration, or ``?`` without one."""
        if not self.config:
            return "?"
        flat = {key: str(value) for key, value in flatten(self.config)}
        return hashlib.sha256(json.dumps(flat, sort_keys=True).encode()).hexdigest()[:_DIGITS]

    @property
    def config_text(self) -> str:
        """The configuration as YAML."""
        return yaml.safe_dump(self.config, sort_keys=False)

    @property
    def checkpoint(self) -> str:
        """Epoch and updates of the evaluated checkpoint, or ``?``."""
        epoch = self.state.get("epoch")
        return "?" if epoch is None else f"epoch {epoch}, {self.state.get('updates')} updates"

    @property
    def commit(self) -> str:
        """Commit of the program that evaluated it, with ``+`` if modified; else its version; else ``?``."""
        known = self.results.provenance if self.results is not None else {}
        if isinstance(commit := known.get("commit"), str):
            return commit[:_DIGITS] + ("+" if known.get("modified") else "")
        return f"gausim {known['gausim']}" if isinstance(known.get("gausim"), str) else "?"

    @property
    def data_hashes(self) -> dict[str, list[str]]:
        """First digits of the hashes of every object's scene and manifest, or ``?`` if not recorded."""
        files = ("scene", "manifest")
        return {
            name: [str(dig(info.sources, file, "sha256") or "?")[:_DIGITS] for file in files]
            for name, info in self.objects.items()
        }

    @property
    def is_from_unfinished(self) -> bool:
        """Whether its figures are of an unfinished training."""
        return self.state.get("finished") is False


def find_runs(roots: Sequence[Path], *, skip: Path | None = None) -> list[RunRecord]:
    """Runs at or below ``roots``, but not in ``skip``, each once, in the natural order of their paths (2 before 10).

    Raises:
        RunError: a root is no directory, or there is no run at all.
    """
    found: dict[Path, RunRecord] = {}
    for root in roots:
        if not root.is_dir():
            raise RunError(f"{root}: no such directory. Name run directories, sweeps, or a folder of them.")
        for folder in _run_folders(root, skip.resolve() if skip is not None else None):
            name = root.name if folder == root else str(folder.relative_to(root))
            found.setdefault(folder.resolve(), _read_run(folder, f"{root.name}/{name}" if len(roots) > 1 else name))
    if not found:
        places = ", ".join(map(str, roots))
        raise RunError(f"{places}: no run in here (no {CONFIG} of `gausim train`). Train and evaluate first.")
    return list(found.values())


def _run_folders(root: Path, skip: Path | None) -> Iterator[Path]:
    """Run directories, and directories of Hydra jobs that did not start a run."""
    alive, dead = list[Path](), list[Path]()
    for name, folders, files in os.walk(root):
        folder = Path(name)
        folders[:] = sorted(f for f in folders if not f.startswith(".") and (folder / f).resolve() != skip)
        if CONFIG in files and _is_run(folder):
            folders.clear()
            alive.append(folder)
        elif (folder / HYDRA / CONFIG).is_file():
            dead.append(folder)
    dead = [d for d in dead if not any(a.is_relative_to(d) for a in alive)]
    yield from sorted(alive + dead, key=lambda folder: [natural(part) for part in folder.parts])


def _is_run(folder: Path) -> bool:
    try:
        return _KEYS_OF_A_RUN <= set(read_yaml(folder / CONFIG))
    except ValueError:
        return any((folder / trace).exists() for trace in _TRACES)


def _read_run(folder: Path, name: str) -> RunRecord:
    job, choices = hydra_record(folder)
    made = partial(RunRecord, folder, name, choices=choices, command=_command(folder, job))
    is_run = (folder / CONFIG).is_file()
    path = (folder if is_run else folder / HYDRA) / CONFIG
    try:
        config = read_yaml(path)
    except ValueError as error:
        return made(BROKEN, str(error))
    metrics = folder / EVALUATION
    if not metrics.is_file():
        return made(*_state(folder, is_run), config)
    try:
        results = load_results(metrics)
    except RunError as error:
        return made(BROKEN, str(error), config)
    unfinished = results.run.get("finished") is False
    detail = f"measured before it was finished, {_progress(folder)}" if unfinished else ""
    return made(EVALUATED, detail, config, results=results)


def _command(folder: Path, job: dict[str, Any]) -> str:
    """The command of a run from Hydra's records: of a job that of its sweep, unless another has taken its place."""
    sweep = next((parent for parent in folder.resolve().parents if (parent / _SWEEP).is_file()), None)
    try:
        whole = read_yaml(sweep / _SWEEP) if sweep is not None and dig(job, "hydra", "mode") == "MULTIRUN" else {}
    except ValueError:
        return NOT_RECORDED
    own, words = _words(job), _words(whole)
    values = dict(word.lower().partition("=")[::2] for word in own)
    asked = [word.lower().partition("=")[::2] for word in words]  # Hydra writes the booleans of jobs as False, True
    is_its = bool(words) and all(key in values and values[key] in value for key, value in asked)
    return " ".join(["gausim train", *(["-m", *words] if is_its else own)]) if job else NOT_RECORDED


def _words(config: dict[str, Any]) -> list[str]:
    words = dig(config, "hydra", "overrides", "task")
    return [shlex.quote(str(word)) for word in words] if isinstance(words, list) else []


def _state(folder: Path, is_run: bool) -> tuple[str, str]:
    if (folder / FAILED).is_file():
        lines = (folder / FAILED).read_text(errors="replace").strip().splitlines()
        return FAILURE, lines[-1] if lines else ""
    if (folder / FINISHED).is_file():
        return NOT_EVALUATED, f"gausim evaluate {folder}"
    if not is_run:
        return FAILURE, "ended before training began"
    return UNFINISHED, f"killed, or still running: {_progress(folder)}"


def _progress(folder: Path) -> str:
    """Progress of a run according to its table of epochs."""
    try:
        with (folder / EPOCHS).open(newline="", errors="replace") as file:
            rows = list(csv.DictReader(file))
    except (OSError, csv.Error):
        rows = []
    return f"epoch {rows[-1].get('epoch')}" if rows else "no epoch done"
