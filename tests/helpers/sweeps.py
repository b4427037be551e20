"""What tests of sweeps share: `gausim train -m` on a toy object in forked children that can be killed."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from helpers.simulators import LEVELS
from helpers.toy_object import write_toy_object
from helpers.toy_runs import Server
from helpers.toy_runs import killed as dying  # noqa: F401

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
    with Server() as server:

        def order(name: str, *overrides: str, **death: Any) -> tuple[int, str]:
            argv = ["-m", *TINY, f"data.root={toy}", f"paths.output_root={folder}", f"name={name}", *overrides]
            return server.order(argv, **death)

        order.folder = folder  # type: ignore[attr-defined]
        yield order


def history(run: Path) -> list[str]:
    """The events of a run."""
    return [json.loads(line)["event"] for line in (run / "events.jsonl").read_text().splitlines()]
