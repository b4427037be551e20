"""Blender in an environment of its own, given jobs as a process.

Blender's Python package needs Python 3.11 and numpy 1, which gausim does not; so it never is among gausim's packages.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from gausim.core import GausSimError

BPY = "4.5.15"
REQUIREMENTS = (f"bpy=={BPY}", "numpy<2")
PYTHON = "3.11"
SCRIPT = Path(__file__).with_name("blender_scene.py")
TAIL = 12


class BlenderError(GausSimError):
    """Blender cannot be started, or gave up on a job."""


@dataclass(frozen=True)
class BlenderProcess:
    """Blender as processes of a Python that has bpy."""

    python: Path  # its interpreter
    # those that no process of ours is on; each is bound to one
    cores: SimpleQueue[int] = field(default_factory=lambda: _cores(), repr=False)

    def versions(self) -> dict[str, str]:
        """Versions of bpy, numpy and Python, which decide what comes out.

        Raises:
            BlenderError: bpy cannot be loaded by this Python.
        """
        lines: list[str] = []
        try:
            self.run({"task": "versions"}, lines.append, threading.Event())
            found = json.loads(lines[-1])
        except (IndexError, ValueError):
            raise BlenderError(f"{self.python}: did not print its versions. Is this a Python with bpy?") from None
        except BlenderError as error:
            raise BlenderError(
                f"{error}\n{self.python}: expected a Python with bpy ({', '.join(REQUIREMENTS)})."
            ) from None
        return {name: str(value) for name, value in found.items()}

    def run(self, job: Mapping[str, Any], told: Callable[[str], None], stop: threading.Event) -> None:
        """Does a job of ``data_prep.blender.plan`` in a process of its own, which ends when this one does.

        Args:
            job: plain data.
            told: called at each step.
            stop: when set, the job is given up.

        Raises:
            BlenderError: with what Blender said last.
        """
        core = self.cores.get()
        try:
            self._run_on(core, job, told, stop)
        finally:
            self.cores.put(core)

    def _run_on(self, core: int, job: Mapping[str, Any], told: Callable[[str], None], stop: threading.Event) -> None:
        # -I: no variable of this environment and no module of this folder may change what Blender loads.
        command, pipe = [str(self.python), "-I", str(SCRIPT), str(core)], subprocess.PIPE
        with tempfile.TemporaryFile("w+", errors="replace") as said:
            try:
                process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=said, text=True)
            except OSError as error:
                raise BlenderError(f"{self.python}: cannot be started ({error}).") from error
            try:
                _give(process, job, told, stop)
            finally:
                process.kill()
                code = process.wait()
            if stop.is_set():
                raise BlenderError("stopped, because another job failed.")
            if code != 0:
                said.seek(0)
                lines = [line.rstrip() for line in said if line.strip() and not line.startswith("Fra:")]
                told_last = "\n".join(lines[-TAIL:]) or "(it said nothing)"
                raise BlenderError(f"Blender gave up (exit code {code}):\n{told_last}")


def _cores() -> SimpleQueue[int]:
    if not hasattr(os, "sched_setaffinity"):
        raise BlenderError(
            "Blender's soft body gives the same motion twice only on one core, which this system cannot bind it to. "
            "Make the set on Linux."
        )
    free: SimpleQueue[int] = SimpleQueue()
    for core in sorted(os.sched_getaffinity(0), reverse=True):
        free.put(core)
    return free


def _give(
    process: subprocess.Popen[str], job: Mapping[str, Any], told: Callable[[str], None], stop: threading.Event
) -> None:
    """Hands over the job and listens until the process ends or has to."""
    assert process.stdin is not None and process.stdout is not None
    with process.stdout:
        try:
            with process.stdin:
                process.stdin.write(json.dumps(job))
        except BrokenPipeError:
            pass  # it ended before it read the job; its exit code tells
        for line in process.stdout:
            told(line.strip())
            if stop.is_set():
                return
    process.wait()


def default_python() -> Path:
    """Default interpreter: of an environment in the user's cache directory."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "gausim" / f"blender-{BPY}" / "bin" / "python"


def find_blender(python: Path) -> BlenderProcess:
    """Blender of a Python that has bpy.

    Raises:
        BlenderError: the interpreter is not there; says how to make it.
    """
    if not (python.is_file() and os.access(python, os.X_OK)):
        folder = default_python().parents[1]
        raise BlenderError(
            f"--blender-python {python}: no such program. Make an environment with Blender (about 1 GB), once:\n"
            f"  python{PYTHON} -m venv {folder}\n  {folder}/bin/pip install {' '.join(map(repr, REQUIREMENTS))}"
        )
    return BlenderProcess(python.absolute())
