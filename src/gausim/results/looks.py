"""Looks at the test part of a run's data, in ``evaluation/test.json`` of the run.

    {"schema": "gausim.test/2",
     "looks": [{"date", "commit", "modified", "trials", "epoch", "updates", "sequences": {OBJECT: [NAME, ...]}}, ...]}

``trials`` is the declared number of trials of the method on the development part. A look is recorded before the data
are opened.
"""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from gausim.core import RunError
from gausim.io.files import write_json

SCHEMA = "gausim.test/2"
DEVELOPMENT, TEST_PART = "development", "test"


class _Looks(msgspec.Struct):
    schema: Literal["gausim.test/2"]
    looks: Annotated[list[dict[str, Any]], msgspec.Meta(min_length=1)]


def read_looks(path: Path) -> list[dict[str, Any]]:
    """The looks so far; none without the file.

    Raises:
        RunError: the file is malformed.
    """
    if not path.is_file():
        return []
    try:
        return msgspec.json.decode(path.read_bytes(), type=_Looks).looks
    except (OSError, msgspec.MsgspecError) as error:
        raise RunError(
            f"{path}: expected the record of test evaluations, cannot be read ({error}). Restore it."
        ) from error


def record_look(
    path: Path,
    *,
    trials: int,
    provenance: Mapping[str, Any],
    state: Mapping[str, Any],
    sequences: Mapping[str, Sequence[str]],
) -> int:
    """Adds a look at ``sequences`` (by object) to the file; returns the number of looks.

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
    looks = [*known, look]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"schema": SCHEMA, "looks": looks})
    return len(looks)
