"""The long table of results: one entry per figure, and its file.

The file (schema ``gausim.results/1``) is ``metrics.json`` of an evaluation, and a record of published results
(``docs/results/NAME.json``) that outlives its run directories::

    {"schema", "title",
     "run": {...},          what was evaluated; where the data declare a test part its "part" (development or test), of
                            the test part the declared "trials" and the number of "looks"
     "provenance": {"gausim", "torch", "python", "machine", "commit", "modified"},      of the program that evaluated
     "made": {"recorded", "commits", "commands", "hardware", "test", "missing"},        of a record
     "facts": {NAME: number or text},                                    of a record: what a page's sentences name
     "objects": {NAME: facts of the object, see ObjectInfo},
     "metrics": {KEY: {"label", "unit", "better", "digits"}},
     "table": [[row, kind, object, split, views, metric, seed, value, deviation], ...]}

Values are in the metric's unit. ``split`` is a range of frames (``seen``, ``unseen``, ``unseen_near``, ``unseen_all``),
``+N`` for N frames after the last seen one, ``bounce``, or empty for costs; ``views`` is ``train``, ``heldout``,
``points`` (3D) or empty. ``deviation`` is over sequences. ``KEY_ratio`` is a value over the reference's.
"""

import math
import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import msgspec

from gausim.core import RunError
from gausim.io.files import write_durably

SCHEMA = "gausim.results/1"
STATIC = "static"
# Kinds of rows. An informed row sees the truth and never counts as the best.
Kind = Literal["method", "reference", "informed", "paper"]
METHOD: Final = "method"
REFERENCE: Final = "reference"
INFORMED: Final = "informed"
PAPER: Final = "paper"
SPLIT_TITLES = {"seen": "seen", "unseen": "unseen", "unseen_near": "unseen, first", "unseen_all": "unseen, all"}
VIEW_TITLES = {"points": "3D, true points", "train": "training views", "heldout": "views never trained on"}
NO_FORESIGHT = "Does not extrapolate: its frames after the trained ones repeat what was fitted."


class Entry(msgspec.Struct, array_like=True, frozen=True):
    """One figure of one seed; of a reference, which no seed changes, ``seed`` is None."""

    row: str
    kind: Kind
    object: str
    split: str
    views: str
    metric: str
    seed: int | str | None
    value: float | str | None
    deviation: float | None = None


class Metric(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Display of a metric; ``{reference}`` in its label is the row that ratios divide by."""

    label: str
    unit: str = ""
    better: Literal["", "low", "high", "one"] = ""
    digits: int | None = 2  # after the point; None: as stored


class ObjectInfo(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True):
    """Facts of an evaluated object; ends of splits are exclusive."""

    splits: dict[str, tuple[int, int]] = {}
    reference: str = STATIC  # the row that ratios divide by: static, ballistic, follow hands
    methods: list[str] = []  # rows of methods
    sequences: list[str] = []
    frames: list[int] = []  # of each sequence
    fps: float = 0.0
    train_views: list[str] = []
    heldout_views: list[str] = []
    mean_color: tuple[float, float, float] | None = None  # of the true foreground, in [0, 1]
    max_l2: float = 0.0  # largest per-pixel colour distance of any prediction of the first method
    sources: dict[str, Any] = {}  # files of the data and their hashes
    absent: dict[str, str] = {}  # metrics that could not be computed, and why
    notes: dict[str, list[str]] = {}  # notes on each method, in sentences
    film: str = ""  # caption of film_OBJECT.mp4; empty without a film

    def repeats(self, method: str) -> bool:
        """Whether a method repeats its fitted motion instead of extrapolating."""
        return NO_FORESIGHT in self.notes.get(method, [])


class Made(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True):
    """Origin of a record."""

    recorded: str  # date, or that it was before records existed
    commits: list[str] = []
    commands: list[str] = []
    hardware: list[str] = []
    test: str = ""  # trials and looks, where figures are of a test part
    missing: list[str] = []  # runs without figures, with their state


class Results(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True):
    """Content of a file."""

    schema: str
    title: str = ""
    run: dict[str, Any] = {}
    provenance: dict[str, Any] = {}
    made: Made | None = None
    facts: dict[str, float | str] = {}
    objects: dict[str, ObjectInfo] = {}
    metrics: dict[str, Metric] = {}
    table: list[Entry] = []

    def __post_init__(self) -> None:
        unknown = {e.metric for e in self.table} - set(self.metrics)
        strange = {e.object for e in self.table} - set(self.objects)
        if unknown or strange:
            raise ValueError(f"table: metrics {sorted(unknown)} and objects {sorted(strange)} are not described")


class Cell(NamedTuple):
    """A figure over seeds: its mean, each seed's value, and deviations over seeds and over sequences."""

    value: float | str
    seeds: tuple[float, ...] = ()
    seed_std: float | None = None  # sample standard deviation of the seeds (n - 1); None for one seed
    std: float | None = None  # root of the mean square over seeds

    @property
    def number(self) -> float | None:
        """The mean if it is a number."""
        return None if isinstance(self.value, str) else self.value


def pooled(entries: Iterable[Entry]) -> Cell | None:
    """One figure over its seeds; None without a finite number or a text."""
    known = [e for e in entries if isinstance(e.value, str) or (e.value is not None and math.isfinite(e.value))]
    if not known or isinstance(known[0].value, str):
        return Cell(known[0].value) if known and isinstance(known[0].value, str) else None
    seeds = tuple(float(e.value) for e in known if not isinstance(e.value, str) and e.value is not None)
    stds = [e.deviation for e in known if e.deviation is not None]
    std = math.sqrt(sum(s * s for s in stds) / len(stds)) if stds else None
    return Cell(statistics.fmean(seeds), seeds, statistics.stdev(seeds) if len(seeds) > 1 else None, std)


def save_results(path: Path, results: Results) -> None:
    """Writes the file, one entry of the table per line."""
    whole = msgspec.to_builtins(results)
    table = ",\n  ".join(msgspec.json.encode(entry).decode() for entry in results.table)
    head = msgspec.json.format(msgspec.json.encode(whole | {"table": []}), indent=1).decode()
    write_durably(path, head.replace('"table": []', f'"table": [\n  {table}\n ]').encode() + b"\n")


def load_results(path: Path, advice: str = "Run `gausim evaluate RUN` again.") -> Results:
    """Reads a file of :func:`save_results`.

    Raises:
        RunError: the file is missing, of another schema, or a field is missing or malformed.
    """
    try:
        schema = msgspec.json.decode(path.read_bytes(), type=dict[str, Any]).get("schema")
        if schema != SCHEMA:
            raise RunError(f"{path}: field 'schema' is {schema!r}, expected {SCHEMA!r}. {advice}")
        return msgspec.json.decode(path.read_bytes(), type=Results)
    except FileNotFoundError:
        raise RunError(f"{path}: no such file. {advice}") from None
    except (OSError, ValueError, msgspec.MsgspecError) as error:
        raise RunError(f"{path}: cannot be read ({error}). {advice}") from error
