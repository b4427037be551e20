"""What tests of sweeps share: `gausim train -m` on a toy object in forked children that can be killed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from helpers.simulators import LEVELS
from helpers.toy_object import write_toy_object

TESTS = Path(__file__).parents[1]
TINY = (
    "model=gausim_paper", "model.simulator.network.layers=1", "model.simulator.network.hidden=8", LEVELS,
    "data.curriculum.t_max=2", "data.curriculum.t_start=1", "data.repeats=2", "data.batch_size=1",
    "trainer=cpu", "trainer.threads=1", "trainer.max_epochs=2",
    "trainer.progress=false", "render=reference", "callbacks.panels=null", "logger=none",
)  # fmt: skip


@contextmanager
def sweeper(folder: Path) -> Iterator[Callable[..., tuple[int, str]]]:
    """A function that sweeps: name, overrides, and how it dies; returns the exit status and the output."""
    toy = write_toy_object(folder / "toy", frames=8).root
    program = [sys.executable, str(TESTS / "helpers" / "killed_runs.py")]
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdin is not None and server.stdout is not None

        def order(name: str, *overrides: str, **death: Any) -> tuple[int, str]:
            argv = ["-m", *TINY, f"data.root={toy}", f"paths.output_root={folder}", f"name={name}", *overrides]
            server.stdin.write(json.dumps({"argv": argv, **death}) + "\n")
            server.stdin.flush()
            found = json.loads(server.stdout.readline())
            return found["status"], found["output"]

        order.folder = folder  # type: ignore[attr-defined]
        yield order
        server.stdin.close()


def dying(target: str, count: int, match: str = "", when: str = "before") -> dict[str, Any]:
    """Where a sweep dies: before or after the count-th call of a function."""
    return {"die": [{"target": target, "match": match, "count": count, "when": when}]}


def history(run: Path) -> list[str]:
    """The events of a run."""
    return [json.loads(line)["event"] for line in (run / "events.jsonl").read_text().splitlines()]
