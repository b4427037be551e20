"""What tests of sweeps share: `gausim train -m` on a toy object in forked children that can be killed."""

import json
from pathlib import Path
from typing import Any

from helpers.simulators import SMALLEST
from helpers.toy_object import write_toy_object
from helpers.toy_runs import Server
from helpers.toy_runs import killed as dying  # noqa: F401

TINY = (
    *SMALLEST, "model=gausim_paper", "plan.t_max=2", "plan.t_start=1", "plan.repeats=2",
    "plan.batch_size=1", "trainer=cpu", "plan.epochs=2", "render=reference", "logger=none",
)  # fmt: skip


class Sweeps:
    """A function that sweeps a toy object: name, overrides, and how it dies; returns exit status and output."""

    def __init__(self, server: Server, folder: Path) -> None:
        self._server, self.folder = server, folder
        self._toy = write_toy_object(folder / "toy", frames=8).root

    def __call__(self, name: str, *overrides: str, **death: Any) -> tuple[int, str]:
        given = (f"data.root={self._toy}", f"output_root={self.folder}", f"name={name}")
        return self._server.order(["-m", *TINY, *given, *overrides], **death)


def history(run: Path) -> list[str]:
    """The events of a run."""
    return [json.loads(line)["event"] for line in (run / "events.jsonl").read_text().splitlines()]
