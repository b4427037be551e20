"""Runs `gausim train` in forked children, so that one start of Python serves many runs, and has them die.

A program, not a test: it reads one JSON object per line. Of a run (argv, die, kill_after, limit) it answers the child's
exit status (negative: the signal) and output, of a check of ranks what ``rank_checks.py`` finds. Nothing here runs a
backward pass: after one, torch refuses to fork.
"""

import json
import os
import pydoc
import random
import resource
import select
import signal
import sys
import tempfile
import traceback
from pathlib import Path
from typing import Any

import numpy as np
import torch

import gausim.cli.training_run
import gausim.compose.build
import gausim.training.callbacks.panels
import gausim.training.dashboards  # noqa: F401
from gausim.cli.main import main
from gausim.training.module import GausSimModule


def die_at(target: str, match: str, count: int, when: str, rank: int = 0, by: str = "SIGKILL") -> None:
    """Ends a rank by a signal before or after our count-th call of ``target`` with ``match`` in its arguments."""

    def kill() -> None:
        others = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
        os.kill(int(sorted(others, key=int)[rank - 1]) if rank else os.getpid(), signal.Signals[by])

    home, name = target.rsplit(".", 1)
    owner = pydoc.locate(home)
    original, calls = getattr(owner, name), 0

    def dying(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls += match in " ".join(map(str, args)) if match else 1
        if when == "before" and calls == count:
            kill()
        result = original(*args, **kwargs)
        if when == "after" and calls == count:
            kill()
        return result

    setattr(owner, name, dying)


def draw_from_global_generators() -> None:
    """Lets every training step draw numbers as a careless library would; a resumed run must draw the next ones."""
    original = GausSimModule.training_step

    def careless(self: GausSimModule, *args: Any) -> None:
        random.random(), np.random.rand(), torch.rand(())
        original(self, *args)

    GausSimModule.training_step = careless  # type: ignore[method-assign]


def child(order: dict[str, Any]) -> int:
    """Trains."""
    torch.set_num_threads(1)
    if order.get("limit"):
        resource.setrlimit(resource.RLIMIT_FSIZE, (order["limit"], order["limit"]))
    draw_from_global_generators()
    for point in order.get("die") or []:
        die_at(**point)
    try:
        return main(["train", *order["argv"]])
    except BaseException:
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


def answer(order: dict[str, Any]) -> Any:
    """Forks, waits, and kills after ``kill_after`` seconds where that is asked for."""
    if "check" in order:
        from helpers import rank_checks  # which takes a while

        return rank_checks.run(order)
    with tempfile.TemporaryFile() as log:
        pid = os.fork()
        if pid == 0:
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
            os._exit(child(order))
        if order.get("kill_after"):
            handle = os.pidfd_open(pid)
            if not select.select([handle], [], [], order["kill_after"])[0]:
                os.kill(pid, signal.SIGKILL)
            os.close(handle)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        log.seek(0)
        return {"status": status, "output": log.read().decode(errors="replace")}


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        answers.write(json.dumps(answer(json.loads(line))) + "\n")
        answers.flush()
