"""Blender in an environment of its own: created once, found again, and given jobs as a process.

Blender's Python package needs Python 3.11 and numpy 1, which gausim does not; so it never is among gausim's packages.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from gausim.core import ConfigError, DataError, GausSimError
from gausim.io.files import write_durably

BPY = "4.5.15"
REQUIREMENTS = (f"bpy=={BPY}", "numpy<2")
PYTHON = "3.11"
# Marker file of an environment, written when it is complete.
MARKER = "gausim-blender.json"
INTERPRETER = Path("bin") / "python"
SCRIPT = Path(__file__).with_name("blender_scene.py")
TAIL = 12


class BlenderError(GausSimError):
    """Blender cannot be installed or started, or gave up on a job."""


Runner = Callable[..., subprocess.CompletedProcess[str]]


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
            raise BlenderError(f"{self.python}: did not tell its versions. Is this a Python with bpy?") from None
        except BlenderError as error:
            raise BlenderError(
                f"{error}\n{self.python}: expected a Python with bpy ({', '.join(REQUIREMENTS)}). Leave out "
                "--blender-python to have one made, or remove the broken --blender-env."
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
                raise BlenderError(f"Blender gave up (exit code {code}):\n{_tail(said)}")


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


def _tail(said: Any) -> str:
    said.seek(0)
    lines = [line.rstrip() for line in said if line.strip() and not line.startswith("Fra:")]
    return "\n".join(lines[-TAIL:]) or "(it said nothing)"


def default_environment() -> Path:
    """Default directory of the environment, in the user's cache directory."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache) / "gausim" / f"blender-{BPY}"


def find_blender(python: Path | None, folder: Path, *, run: Runner = subprocess.run) -> BlenderProcess:
    """Blender of a Python of one's own, or of the environment in ``folder``, which is created where it is missing.

    Raises:
        BlenderError: the interpreter is not there, or the environment cannot be created.
        DataError: ``folder`` holds something else.
    """
    if python is None:
        return BlenderProcess(create_environment(folder, run=run))
    if not (python.is_file() and os.access(python, os.X_OK)):
        raise BlenderError(f"--blender-python {python}: expected a Python interpreter that has bpy; no such program.")
    return BlenderProcess(python.absolute())


def create_environment(folder: Path, *, run: Runner = subprocess.run) -> Path:
    """The interpreter of the environment in ``folder``, after creating it if it is not there yet.

    It is made beside ``folder`` and takes its name when it is complete; a second process waits for the first.
    """
    folder = folder.absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_name(f".{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not _is_ready(folder):
            base = _base_python(run)
            making = folder.with_name(f".{folder.name}.making")
            shutil.rmtree(making, ignore_errors=True)
            told = f"Creating an environment for Blender in {folder} (once; {', '.join(REQUIREMENTS)}, about 1 GB) ..."
            print(told, file=sys.stderr, flush=True)
            try:
                _install(making, base, run)
                write_durably(making / MARKER, json.dumps({"requirements": list(REQUIREMENTS)}).encode())
                os.replace(making, folder)
            finally:
                shutil.rmtree(making, ignore_errors=True)
    return folder / INTERPRETER


def _is_ready(folder: Path) -> bool:
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    try:
        ready = json.loads((folder / MARKER).read_bytes())["requirements"] == list(REQUIREMENTS)
    except (OSError, ValueError, KeyError, TypeError):
        ready = False
    if not ready or not (folder / INTERPRETER).exists():
        raise DataError(
            f"--blender-env {folder}: exists and is not an environment for {', '.join(REQUIREMENTS)} made by this "
            "command. Choose another folder, or remove this one."
        )
    return True


def _install(folder: Path, base: Path, run: Runner) -> None:
    pip = [str(folder / INTERPRETER), "-I", "-m", "pip", "install", "--disable-pip-version-check", *REQUIREMENTS]
    for command in ([str(base), "-m", "venv", str(folder)], pip):
        done = run(command, capture_output=True, text=True)
        if done.returncode != 0:
            said = "\n".join((done.stderr or done.stdout or "").strip().splitlines()[-TAIL:])
            raise BlenderError(
                f"{' '.join(command)}: failed (exit code {done.returncode}):\n{said}\nMend this, or bring a Python "
                "that has bpy with --blender-python."
            )


def _base_python(run: Runner) -> Path:
    """An interpreter of the version that bpy is made for."""
    for candidate in (sys.executable, shutil.which(f"python{PYTHON}")):
        if candidate:
            question = [candidate, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
            done = run(question, capture_output=True, text=True)
            if done.returncode == 0 and done.stdout.strip() == PYTHON:
                return Path(candidate)
    raise ConfigError(
        f"bpy {BPY} needs Python {PYTHON}, and there is no python{PYTHON} on the path. Install it, or bring a Python "
        "that has bpy with --blender-python."
    )
