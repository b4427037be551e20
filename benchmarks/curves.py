"""Error against processor time of trainings: ``python -m benchmarks.curves DIR FILE.json``.

Collects ``motion.csv`` of the runs below a directory, made with ``trainer.motion_epochs=1``, into a record.
"""

from __future__ import annotations

import csv
import datetime
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from gausim.io.files import read_yaml
from gausim.results.table import METHOD, SCHEMA, Entry, Made, Metric, ObjectInfo, Results, save_results
from gausim.runs import provenance
from gausim.runs.names import CONFIG, MOTION

METRICS = {
    f"error_{frames}": Metric(f"3D error in {frames} frames, relative to static", "", "low", 4)
    for frames in ("seen", "unseen")
}


def curves(folder: Path) -> Results:
    """The record: rows are epochs and processor seconds, objects are ``OBJECT, EPOCHS epochs``."""
    table = [entry for path in sorted(folder.glob(f"**/{MOTION}")) for entry in _entries(path)]
    names = dict.fromkeys(entry.object for entry in table)
    made = Made(
        datetime.date.today().isoformat(), [str(provenance.code_provenance()["commit"])[:8]],
        ["bash docs/results/commands/curves.sh"], [provenance.machine()],
    )  # fmt: skip
    return Results(
        SCHEMA, "Error against processor time of the training", made=made, metrics=METRICS, table=table,
        objects={name: ObjectInfo() for name in names},
    )  # fmt: skip


def _entries(path: Path) -> Iterator[Entry]:
    config = read_yaml(path.parent / CONFIG)
    epochs = config["plan"]["epochs"]
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            label, name = f"{row['epoch']} | {row['cpu_seconds']}", f"{row['object']}, {epochs} epochs"
            for metric in METRICS:
                yield Entry(label, METHOD, name, "", "", metric, config["seed"], float(row[metric]))


def main(argv: Sequence[str]) -> int:
    """Writes the record and prints how many points it has."""
    found = curves(Path(argv[0]))
    save_results(Path(argv[1]), found)
    print(f"{argv[1]}: {len(found.table)} figures of {len(found.objects)} curves")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
