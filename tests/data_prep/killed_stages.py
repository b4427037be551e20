"""Runs stages in forked children, so that one start of Python serves many, and has them die.

A program, not a test: it reads one JSON object per line (stage, argv, die) and answers with the child's exit status
(negative: the signal), its output, and how many places it passed. Places are where a stage writes, renames or removes
beside its result; what numba keeps in its cache on the way, once, is no such place.
"""

import importlib
import json
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import torch

import gausim.data.verify
import gausim.io.ply
import gausim.render.cpu  # noqa: F401
from gausim.cli.prepare import STAGES

PLACES = ((os, "replace"), (os, "fsync"), (Path, "unlink"), (shutil, "rmtree"))


def count_places(die: int | None, told: int, folder: Path) -> None:
    """Numbers the calls of what changes the disk below a folder, and ends the process before the one called ``die``."""
    passed = 0

    def wrapped(original: Callable[..., Any]) -> Callable[..., Any]:
        def called(*args: Any, **kwargs: Any) -> Any:
            nonlocal passed
            place = os.readlink(f"/proc/self/fd/{args[0]}") if isinstance(args[0], int) else str(args[0])
            if not Path(place).is_relative_to(folder):
                return original(*args, **kwargs)
            if passed == die:
                os.kill(os.getpid(), signal.SIGKILL)
            passed += 1
            os.pwrite(told, f"{passed:8d}".encode(), 0)
            return original(*args, **kwargs)

        return called

    for owner, name in PLACES:
        setattr(owner, name, wrapped(getattr(owner, name)))


def answer(order: dict[str, Any]) -> dict[str, Any]:
    """Forks a child for one stage and waits for it."""
    with tempfile.TemporaryFile() as log, tempfile.TemporaryFile() as told:
        pid = os.fork()
        if pid == 0:
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
            torch.set_num_threads(1)
            cv2.setNumThreads(1)
            out = Path(order["argv"][order["argv"].index("--out") + 1])
            count_places(order.get("die"), told.fileno(), out.parent)
            status = 1
            try:
                status = importlib.import_module(f"data_prep.{order['stage'].partition('-')[0]}").main(order["argv"])
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        log.seek(0)
        told.seek(0)
        return {"status": status, "output": log.read().decode(errors="replace"), "places": int(told.read() or b"0")}


if __name__ == "__main__":
    for stage in STAGES:
        importlib.import_module(f"data_prep.{stage}")
    answers = os.fdopen(os.dup(1), "w")
    for line in sys.stdin:
        answers.write(json.dumps(answer(json.loads(line))) + "\n")
        answers.flush()
