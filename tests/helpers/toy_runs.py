"""`gausim train` on the toy object, as small as it gets: once per session for all who need a trained run."""

import csv
import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Self

import torch

from gausim.runs.checkpoint import read_checkpoint
from helpers import toy_object
from helpers.plain import digest
from helpers.shared import Shared
from helpers.simulators import SMALLEST

# The smallest run in which everything happens that a resumed run could get wrong.
TINY = (
    *SMALLEST, "model=gausim_paper", "plan.repeats=2", "plan.t_max=3", "plan.t_start=1",
    "plan.batch_size=1", "render=cpu", "render.threads=1", "trainer.log_every_n_steps=1",
)  # fmt: skip


TESTS = Path(__file__).parents[1]


class Server:
    """A program that answers each line of JSON by another, and starts when it is first needed."""

    def __init__(self, program: Path = TESTS / "helpers" / "killed_runs.py") -> None:
        self._program = program
        self._process: subprocess.Popen[str] | None = None

    def ask(self, **order: Any) -> Any:
        if self._process is None:
            path = os.pathsep.join([str(TESTS), str(TESTS.parent), os.environ.get("PYTHONPATH", "")])
            self._process = subprocess.Popen(
                [sys.executable, str(self._program)], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": path},
            )  # fmt: skip
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def order(self, argv: list[str], **death: Any) -> tuple[int, str]:
        """Exit status (negative: the signal) and output of `gausim train`."""
        found = self.ask(argv=argv, **death)
        return found["status"], found["output"]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.communicate()  # closes its input, at which it ends


class Trainings(Server):
    """Trains a toy object with three sequences in processes of their own, which may be killed.

    Attributes:
        folder: where the runs go.
    """

    def __init__(self, shared: Shared) -> None:
        super().__init__()
        self._shared = shared
        self.folder = shared("toy_runs", Path.mkdir)
        self.given = (f"data.root={shared('toy_of_three', _write_toy)}", f"output_root={self.folder}", *TINY)

    def moving(self, kind: str) -> str:
        """An override: the object as a free body that falls onto a floor, or in a hand that moves."""
        return f"data.root={self._shared(f'toy_{kind}', _MOVING[kind])}"

    def __call__(self, name: str, *overrides: str, **death: Any) -> tuple[int, str]:
        return self.order([*self.given, f"name={name}", *overrides], **death)

    def whole(self, name: str, *overrides: str) -> Path:
        """A run that nothing disturbs, made once per session; what it said is in ``NAME.txt``."""

        def make(folder: Path) -> None:
            status, output = self(name, *overrides)
            assert status == 0, output
            (self.folder / f"{name}.txt").write_text(output)

        self._shared(f"made_{name}", make)
        return self.run(name)

    def run(self, name: str) -> Path:
        """The directory of a run."""
        return self.folder / name / "seed_0"


def _write_toy(folder: Path) -> None:
    amplitudes = {**toy_object.AMPLITUDES, "seq_002": 0.3}
    toy_object.write_object(toy_object.ToyObject(folder, toy_object.toy_scene(), amplitudes=amplitudes))


def _write_falling(folder: Path) -> None:
    scene = toy_object.toy_scene()
    scene = dataclasses.replace(scene, pinned=torch.zeros_like(scene.pinned))
    toy_object.write_object(toy_object.ToyObject(folder, scene))
    floor = {"point": [0.0, 0.0, -0.02], "normal": [0.0, 0.0, 1.0]}  # friction and restitution are trained
    toy_object.surround(folder, free=True, gravity="trained", floor=floor)


def _write_held(folder: Path) -> None:
    toy = toy_object.write_toy_object(folder)
    way = 0.03 * torch.arange(toy.frames)[:, None] * torch.tensor([1.0, 0.0, 0.5])
    toy_object.hold(folder, toy.scene.means[toy.scene.pinned][:4], way)


_MOVING = {"falling": _write_falling, "held": _write_held}


def rows(path: Path) -> list[dict[str, str]]:
    """A table of a run without its seconds."""
    with path.open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def killed(target: str, count: int, **how: Any) -> dict[str, Any]:
    """A death at the count-th call of a function; ``how`` are the other arguments of ``killed_runs.die_at``."""
    return {"die": [{"target": target, "match": "", "count": count, "when": "before", **how}]}


def learned(run: Path) -> dict[str, str]:
    """Digests of all that a checkpoint holds, seconds aside."""
    loaded = read_checkpoint(run / "last.ckpt")
    kept = {k: v for k, v in loaded.items() if k not in ("callbacks", "cost")}
    parts = {k: entry if isinstance(entry, dict) else {"": entry} for k, entry in kept.items()}
    return {f"{k}.{name}": digest(v) for k, entry in parts.items() for name, v in entry.items()}


def assert_same_run(found: Path, expected: Path) -> None:
    """Everything that two runs have left is the same, bit for bit."""
    assert learned(found) == learned(expected)
    table = rows(expected / "epochs.csv")
    assert len(table) > 1 and rows(found / "epochs.csv") == table
    assert (found / "FINISHED").read_text() == (expected / "FINISHED").read_text()
    assert list(found.glob(".*.tmp")) == []
