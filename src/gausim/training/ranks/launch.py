"""Start and end of the ranks of a run; one process may have several runs one after the other.

The first rank builds its run and then starts the others, which receive the resolved configuration from it: no command
line is parsed twice, so a job of a sweep never starts another sweep. Ranks that a scheduler (SLURM, torchrun) has
started are used as they are. After a run its process group and environment variables are removed.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import TracebackType

import torch
from lightning.pytorch.plugins.environments import ClusterEnvironment, SLURMEnvironment, TorchElasticEnvironment
from lightning.pytorch.utilities import rank_zero_only
from torch import distributed as dist

from gausim.core import ConfigError, GausSimError, RunError
from gausim.training.ranks.layout import LOCALHOST, Layout, LocalRanks
from gausim.training.ranks.ranks import Ranks, is_lost_connection

# Seconds between checks of the other ranks; until ranks that do not end are killed; and until this process is killed
# after the loss of another rank (it may be waiting for a device that will never answer).
LOOK, ENDING, NOTICING = 0.05, 30.0, 60.0
UNHARMED = "The last checkpoint, if any, is unharmed; the same command continues from it."


class Crew:
    """The ranks of one run, from their start to their end; a context manager.

    ``environment`` is Lightning's cluster environment of this rank, None for a run of one rank.
    """

    def __init__(
        self, layout: Layout, follow: Callable[[Crew], object] | None = None, *, rank: int = 0, port: int | None = None
    ) -> None:
        """``follow`` is the function (of a module) that the other ranks on this machine call.

        A rank started by another process has the number ``rank`` and finds the first rank's store at ``port``.
        """
        self.layout, self.ranks = layout, Ranks()
        self.environment: ClusterEnvironment | None = None
        self._follow, self._rank, self._port = follow, rank, port
        self._timeout = timedelta(minutes=layout.timeout_minutes)
        self._others: dict[int, SpawnProcess] = {}
        self._logs: tempfile.TemporaryDirectory[str] | None = None
        self._store: dist.TCPStore | None = None
        self._kept = {name: os.environ.get(name) for name in ("MASTER_ADDR", "MASTER_PORT")}

    # ------------------------------------------------------------------------------------------------ coming together

    def __enter__(self) -> Crew:
        """Joins ranks that run already; without a scheduler, the first rank remains alone until :meth:`start`."""
        if self._port is not None:
            self._store = dist.TCPStore(
                LOCALHOST, self._port, self.layout.size, False, self._timeout, wait_for_workers=False
            )
            self._store.set(f"here/{self._rank}", "")
            self._meet(self._rank, self._store)
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

    def _meet(self, rank: int, store: dist.TCPStore) -> None:
        size = self.layout.size
        dist.init_process_group(self.layout.backend, store=store, rank=rank, world_size=size, timeout=self._timeout)
        self.environment = LocalRanks(rank, size, store.port)

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
        dist.init_process_group(
            self.layout.backend, init_method=f"tcp://{env.main_address}:{env.main_port}", rank=env.global_rank(),
            world_size=env.world_size(), timeout=self._timeout,
        )  # fmt: skip
        self.environment = env

    @property
    def is_first(self) -> bool:
        """Whether this is the rank that writes."""
        return self.environment is None or self.environment.global_rank() == 0

    def start(self, task: object) -> None:
        """Starts the other ranks, unless a scheduler did, and sends them the task (plain data)."""
        if self.layout.size == 1 or self.environment is not None:
            return
        self._store = dist.TCPStore(LOCALHOST, 0, self.layout.size, True, self._timeout, wait_for_workers=False)
        self._logs = tempfile.TemporaryDirectory()
        for rank in range(1, self.layout.size):
            given = self._follow, self.layout, rank, self._store.port, str(self._log(rank))
            self._others[rank] = multiprocessing.get_context("spawn").Process(target=_run_rank, args=given)
            self._others[rank].start()
        deadline = time.monotonic() + self._timeout.total_seconds()
        while not self._store.check([f"here/{rank}" for rank in self._others]):
            if gone := self._obituary():
                raise RunError(gone)
            if time.monotonic() > deadline:
                minutes = self.layout.timeout_minutes
                raise RunError(f"ranks 1 to {self.layout.size - 1} did not start within {minutes:g} minutes.")
            time.sleep(LOOK)
        self._meet(0, self._store)
        threading.Thread(target=self._watch, daemon=True, name="ranks").start()
        self.ranks.first(lambda: task)

    # ------------------------------------------------------------------------------------------------ ending

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Waits for the end of all ranks; after an error of this one, ends the others at once.

        Raises:
            RunError: another rank has failed; names the rank and its error.
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
        """Waits until all ranks have finished."""
        if self.ranks.size > 1:
            dist.barrier()
        deadline = time.monotonic() + ENDING
        for rank, process in self._others.items():
            process.join(max(0.0, deadline - time.monotonic()))
            if process.exitcode is None:
                warnings.warn(f"rank {rank} did not end by itself after the run and was ended.", stacklevel=3)

    def _explain(self, error: BaseException) -> None:
        """Replaces the error of a broken connection by one that names the failed rank and its last output."""
        if not is_lost_connection(error):
            return
        deadline = time.monotonic() + ENDING / 3
        while self._others and time.monotonic() < deadline and all(p.exitcode is None for p in self._others.values()):
            time.sleep(LOOK)  # a connection breaks shortly before its process ends
        if gone := self._obituary():
            raise RunError(gone) from error
        words = (str(error) or type(error).__name__).splitlines()[0]
        raise RunError(
            f"rank {self.ranks.rank}: the connection to the other ranks is lost ({words}). One of them has ended or "
            f"did not answer in time; its output tells why. {UNHARMED}"
        ) from error

    def _end(self) -> None:
        others, self._others = self._others, {}
        for process in others.values():
            process.kill()
            process.join()
        if dist.is_initialized():
            with suppress(RuntimeError):  # of ranks that have ended
                dist.destroy_process_group()
        if self._logs is not None:
            self._logs.cleanup()
        self._store, self.environment = None, None
        for name, value in self._kept.items():  # Lightning's environments set them
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value

    def _watch(self) -> None:
        """Kills this process if it does not react to the loss of another rank: it may wait on a device for ever."""
        others, told = self._others, None
        while self._others is others:
            time.sleep(LOOK * 10)
            gone = self._obituary()
            if gone is not None:
                told = told or time.monotonic()
                if time.monotonic() - told > NOTICING and self._others is others:
                    print(f"error: {gone}", file=sys.stderr, flush=True)
                    os._exit(2)

    def _obituary(self) -> str | None:
        """Exit status and last output of the first rank that failed; None if none did."""
        for rank, process in self._others.items():
            status = process.exitcode
            if status not in (None, 0):
                how = f"was ended by signal {-status}" if status < 0 else f"ended with status {status}"
                hint = " (out of memory?)" if status == -9 else ""
                said = self._log(rank).read_text(errors="replace").strip().splitlines()[-8:]
                words = ":\n  " + "\n  ".join(said) + "\n" if said else ". "
                return f"rank {rank} {how}{hint}{words}{UNHARMED}"
        return None

    def _log(self, rank: int) -> Path:
        assert self._logs is not None
        return Path(self._logs.name) / f"rank_{rank}.txt"


def _run_rank(follow: Callable[[Crew], object], layout: Layout, rank: int, port: int, log: str) -> None:
    """Main function of another rank's process, which ends with the first rank; its output goes to ``log``."""
    os.setsid()  # an interrupt from the keyboard is for the first rank alone
    with open(log, "wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    threading.Thread(target=_end_with_first, daemon=True, name="first rank").start()
    rank_zero_only.rank = rank  # type: ignore[attr-defined]
    try:
        with Crew(layout, rank=rank, port=port) as crew:
            follow(crew)
    except GausSimError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def _end_with_first() -> None:
    first = multiprocessing.parent_process()
    assert first is not None
    first.join()
    os._exit(1)
