"""Looks at the test part of a run's data, in ``evaluation/test.json`` of the run.

    {"schema": "gausim.test/1", "looks": 2, "trials": 8, "date", "commit",    of the first look
     "history": [{"date", "commit", "modified", "trials", "epoch", "updates", "sequences": {OBJECT: [NAME, ...]}}, ...]}

``trials`` is the declared number of trials of the method on the development part. A look is recorded before the data
are opened.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from gausim.core import RunError
from gausim.io.files import write_json

SCHEMA = "gausim.test/1"
DEVELOPMENT, TEST_PART = "development", "test"


class Looks(msgspec.Struct):
    """Content of the file."""

    schema: str  # version of the file
    looks: int  # number of looks
    trials: int  # declared trials on the development part, at the first look
    date: str  # of the first look
    commit: str | None  # of the program at the first look; None if unknown
    history: list[dict[str, Any]]  # every look


def read_looks(path: Path) -> Looks | None:
    """The looks so far; None without the file.

    Raises:
        RunError: the file is malformed.
    """
    if not path.is_file():
        return None
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Looks)
    except (OSError, msgspec.MsgspecError) as error:
        raise RunError(
            f"{path}: expected the record of test evaluations, cannot be read ({error}). Restore it."
        ) from error
    if found.schema != SCHEMA or found.looks != len(found.history) or not found.history:
        raise RunError(
            f"{path}: expected schema {SCHEMA!r} and as many entries of 'history' as 'looks', got {found.schema!r} and "
            f"{len(found.history)} for {found.looks}. Restore it."
        )
    return found


def record_look(
    path: Path,
    *,
    trials: int,
    provenance: Mapping[str, Any],
    state: Mapping[str, Any],
    sequences: Mapping[str, Sequence[str]],
) -> Looks:
    """Adds a look at ``sequences`` (by object) to the file and returns all looks.

    ``trials`` are those declared on the development part, ``provenance`` is
    :func:`gausim.runs.provenance.code_provenance`, ``state`` epoch and updates of the checkpoint.

    Raises:
        RunError: the file is malformed.
    """
    known = read_looks(path)
    look = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "trials": trials,
        **{key: provenance.get(key) for key in ("commit", "modified")},
        **{key: state.get(key) for key in ("epoch", "updates")},
        "sequences": {name: list(found) for name, found in sequences.items()},
    }
    history = [*(known.history if known else ()), look]
    first = history[0]
    made = Looks(SCHEMA, len(history), first["trials"], first["date"], first["commit"], history)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, msgspec.to_builtins(made))
    return made
