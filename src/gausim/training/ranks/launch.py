"""Starts the ranks of a run and brings them together, one run after the other in one process if need be.

The first rank builds its run and then starts the others, which receive the resolved configuration from it: no command
line is parsed twice, so a job of a sweep never starts another sweep. Where a scheduler (SLURM, torchrun) has started
all ranks, nothing is started here. What is set up for a run is gone after it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from types import TracebackType
from typing import IO, Any, TypeVar

import torch
from lightning.pytorch.plugins.environments import ClusterEnvironment, SLURMEnvironment, TorchElasticEnvironment
from torch import distributed as dist

import gausim
from gausim.core import ConfigError, RunError
from gausim.training.ranks.layout import LOCALHOST, Layout, LocalRanks, Place
from gausim.training.ranks.ranks import Ranks, is_lost_connection

T = TypeVar("T")
# Seconds: between looks at the other ranks; for them to end by themselves; for this rank to notice that one is gone
# before it is ended too (it may be waiting for a device that will never answer).
LOOK, ENDING, NOTICING = 0.05, 30.0, 60.0


class Crew:
    """The ranks of one run, from their start to their end; use it as a context.

    Attributes:
        layout: how many there are.
        ranks: what they do together.
        environment: tells Lightning where this rank stands; None for a run of one rank.
    """

    def __init__(self, layout: Layout, program: Sequence[str] = (), place: Place | None = None) -> None:
        """Starts nothing yet.

        Args:
            layout: how many ranks.
            program: command that becomes one more rank on this machine, given :meth:`Place.argv` as further arguments.
            place: of a rank that was started so.
        """
        self.layout, self.ranks = layout, Ranks()
        self.environment: ClusterEnvironment | None = None
        self._program, self._place = tuple(program), place
        self._others: list[_Other] = []
        self._store: dist.TCPStore | None = None
        self._kept = {name: os.environ.get(name) for name in ("MASTER_ADDR", "MASTER_PORT")}

    # ------------------------------------------------------------------------------------------------ coming together

    def __enter__(self) -> Crew:
        """Joins ranks that run already; the first rank of a machine without a scheduler is still alone."""
        if self._place is not None:
            self._join(self._place)
        elif self.layout.size > 1:
            self._check_devices()
            self._join_scheduled()
        return self

    def _check_devices(self) -> None:
        count = torch.cuda.device_count()
        if self.layout.on_gpu and self.layout.devices > count:
            raise ConfigError(
                f"trainer.devices: {self.layout.devices} ranks need as many GPUs, this machine has {count}. Set "
                "trainer.devices to that, or trainer.accelerator=cpu."
            )

    def _join(self, place: Place) -> None:
        timeout = timedelta(seconds=place.timeout)
        self._store = dist.TCPStore(LOCALHOST, place.port, place.size, False, timeout, wait_for_workers=False)
        self._store.set(f"here/{place.rank}", "")
        dist.init_process_group(
            place.backend, store=self._store, rank=place.rank, world_size=place.size, timeout=timeout
        )
        self.environment = LocalRanks(place.rank, place.size, place.port)

    def _join_scheduled(self) -> None:
        env: ClusterEnvironment
        if TorchElasticEnvironment.detect():
            env = TorchElasticEnvironment()
        elif int(os.environ.get("SLURM_NTASKS", "1")) > 1 and SLURMEnvironment.detect():
            env = SLURMEnvironment(auto_requeue=False)
        elif self.layout.num_nodes > 1:
            raise ConfigError(
                f"trainer.num_nodes: {self.layout.num_nodes} machines need a scheduler that starts the ranks (SLURM "
                "with one task per rank, or torchrun), found none. See docs/how-to/clusters-and-gpus.md."
            )
        else:
            return
        if env.world_size() != self.layout.size:
            raise ConfigError(
                f"trainer: the scheduler started {env.world_size()} ranks, expected devices x num_nodes = "
                f"{self.layout.devices} x {self.layout.num_nodes}. Make tasks per node and trainer.devices equal, "
                "and the numbers of nodes."
            )
        address = f"tcp://{env.main_address}:{env.main_port}"
        dist.init_process_group(
            self.layout.backend, init_method=address, rank=env.global_rank(), world_size=env.world_size(),
            timeout=timedelta(minutes=self.layout.timeout_minutes),
        )  # fmt: skip
        self.environment = env

    @property
    def is_first(self) -> bool:
        """Whether this is the rank that writes."""
        return self.environment is None or self.environment.global_rank() == 0

    def announce(self, make: Callable[[], T]) -> T:
        """Makes the task on the first rank and tells it those that run already.

        Raises:
            Exception: what ``make`` raises; they hear of it.
        """
        return self.ranks.first(make)

    def start(self, task: object) -> None:
        """Starts the ranks that nobody has started yet, and tells them the task (plain data)."""
        if self.layout.size > 1 and self.environment is None:
            self._start_others()
            self.ranks.first(lambda: task)

    def receive(self) -> Any:
        """The first rank's task, on another one.

        Raises:
            RunError: it stopped before it had one.
        """
        return self.ranks.first(lambda: None)

    def _start_others(self) -> None:
        size, timeout = self.layout.size, timedelta(minutes=self.layout.timeout_minutes)
        self._store = dist.TCPStore(LOCALHOST, 0, size, True, timeout, wait_for_workers=False)
        for rank in range(1, size):
            place = Place(rank, size, self._store.port, self.layout.backend, timeout.total_seconds())
            self._others.append(_Other(rank, [*self._program, *place.argv()]))
        deadline = time.monotonic() + timeout.total_seconds()
        while not self._store.check([f"here/{other.rank}" for other in self._others]):
            self._check_others()
            if time.monotonic() > deadline:
                raise RunError(f"ranks 1 to {size - 1} did not start within {self.layout.timeout_minutes:g} minutes.")
            time.sleep(LOOK)
        dist.init_process_group(self.layout.backend, store=self._store, rank=0, world_size=size, timeout=timeout)
        self.environment = LocalRanks(0, size, self._store.port)
        threading.Thread(target=self._watch, daemon=True, name="ranks").start()

    # ------------------------------------------------------------------------------------------------ ending

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Ends the ranks together; after an error of this one, the others at once.

        Raises:
            RunError: another rank is gone; says which one and why.
        """
        try:
            if error is None:
                self._part()
        except RuntimeError as lost:
            self._explain(lost)
            raise
        else:
            if error is not None:
                self._explain(error)
        finally:
            self._end()

    def _part(self) -> None:
        """Waits until all have done their work."""
        if self.ranks.size > 1:
            dist.barrier()
        deadline = time.monotonic() + ENDING
        for other in self._others:
            if not other.waited(deadline):
                warnings.warn(f"rank {other.rank} did not end by itself after the run and was ended.", stacklevel=3)

    def _explain(self, error: BaseException) -> None:
        """Says in place of a broken connection which rank is gone and what it said last."""
        if not is_lost_connection(error):
            return
        deadline = time.monotonic() + ENDING / 3
        while self._others and time.monotonic() < deadline and all(o.status is None for o in self._others):
            time.sleep(LOOK)  # its connection breaks a moment before it is gone
        try:
            self._check_others()
        except RunError as told:
            raise told from error
        words = (str(error) or type(error).__name__).splitlines()[0]
        raise RunError(
            f"rank {self.ranks.rank}: the connection to the other ranks is lost ({words}). One of them has ended or "
            "did not answer in time; its output tells why. The last checkpoint, if any, is unharmed; the same command "
            "continues from it."
        ) from error

    def _check_others(self) -> None:
        for other in self._others:
            if other.status not in (None, 0):
                raise RunError(other.obituary())

    def _end(self) -> None:
        others, self._others = self._others, []
        for other in others:
            other.end()
        if dist.is_initialized():
            with suppress(RuntimeError):  # of ranks that are gone
                dist.destroy_process_group()
        self._store, self.environment = None, None
        for name, value in self._kept.items():  # Lightning's environments set them
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value

    def _watch(self) -> None:
        """Ends this process if it does not notice that another rank is gone: a device may wait for it for ever."""
        others, told = self._others, None
        while self._others is others:
            time.sleep(LOOK * 10)
            gone = next((o for o in others if o.status not in (None, 0)), None)
            if gone is not None:
                told = told or time.monotonic()
                if time.monotonic() - told > NOTICING and self._others is others:
                    print(f"error: {gone.obituary()}", file=sys.stderr, flush=True)
                    os._exit(2)


class _Other:
    """A rank that this process started."""

    def __init__(self, rank: int, command: Sequence[str]) -> None:
        """Starts it; it ends itself when the pipe to this process breaks (:func:`end_with_first`)."""
        self.rank = rank
        self._log: IO[bytes] = tempfile.TemporaryFile()
        home = str(Path(gausim.__file__).resolve().parents[1])
        path = os.pathsep.join(filter(None, (home, os.environ.get("PYTHONPATH"))))
        env = {**os.environ, "PYTHONPATH": path, "RANK": str(rank), "LOCAL_RANK": str(rank)}
        self._process = subprocess.Popen(
            command, env=env, stdin=subprocess.PIPE, stdout=self._log, stderr=subprocess.STDOUT, start_new_session=True
        )

    @property
    def status(self) -> int | None:
        """Its exit status (negative: the signal), or None while it runs."""
        return self._process.poll()

    def waited(self, deadline: float) -> bool:
        """Waits for its end; returns whether it came in time."""
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            return False
        return True

    def end(self) -> None:
        """Ends it if it runs."""
        if self.status is None:
            self._process.kill()
        self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._log.close()

    def obituary(self) -> str:
        """How it ended and what it said last."""
        status = self.status or 0
        how = f"was ended by signal {-status}" if status < 0 else f"ended with status {status}"
        hint = " (out of memory?)" if status == -9 else ""
        self._log.seek(0)
        said = self._log.read().decode(errors="replace").strip().splitlines()[-8:]
        words = ":\n  " + "\n  ".join(said) + "\n" if said else ". "
        return (
            f"rank {self.rank} {how}{hint}{words}The last checkpoint, if any, is unharmed; the same command continues "
            "from it."
        )


def end_with_first() -> None:
    """Ends this process as soon as the one that started it is gone; for ranks that :class:`Crew` starts."""

    def watch() -> None:
        sys.stdin.buffer.read()
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="first rank").start()
