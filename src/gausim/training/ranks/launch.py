"""Ranks of a run: Lightning's strategy, and processes that follow the first one by the run directory."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.utilities.seed import reset_seed
from lightning.pytorch.plugins.environments import ClusterEnvironment, SLURMEnvironment, TorchElasticEnvironment
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.strategies.launchers.subprocess_script import _SubprocessScriptLauncher
from lightning.pytorch.utilities import rank_zero_only
from torch import distributed as dist

from gausim.core import ConfigError, GausSimError, RunError
from gausim.training.ranks.layout import Layout

# The program of the other ranks; its argument is the run directory.
FOLLOWER = "gausim.compose.follow"
# Longest that a rank waits for the others.
TIMEOUT = timedelta(minutes=10)


class FollowerLauncher(_SubprocessScriptLauncher):
    """Lightning's launcher, which starts the other ranks of this machine and ends all when one of them dies.

    They read the saved configuration of the run: no command line is parsed twice, so that a job of a sweep starts no
    other sweep. The environment of this process stays as it is, for the next job.
    """

    def __init__(self, environment: ClusterEnvironment, layout: Layout, run_dir: Path) -> None:
        super().__init__(environment, layout.devices, layout.num_nodes)
        self._run_dir = run_dir

    def launch(self, function: Callable[..., Any], *args: Any, trainer: Any = None, **kwargs: Any) -> Any:
        """Starts the ranks and calls the function; returns when all have ended, and ends them after an error."""
        try:
            found = super().launch(function, *args, trainer=trainer, **kwargs)
            for process in self.procs:
                process.wait()
            return found
        finally:
            for process in self.procs:
                process.kill()

    def _call_children_scripts(self) -> None:
        environment = self.cluster_environment
        own = {
            "MASTER_ADDR": environment.main_address, "MASTER_PORT": str(environment.main_port), "NODE_RANK": "0",
            "WORLD_SIZE": str(self.num_processes),
        }  # fmt: skip
        command = [sys.executable, "-m", FOLLOWER, str(self._run_dir)]
        self.procs = [
            subprocess.Popen(command, env={**os.environ, **own, "LOCAL_RANK": str(rank)})
            for rank in range(1, self.num_processes)
        ]


class RanksStrategy(DDPStrategy):
    """Replicas whose loss gradients are added by the module (:meth:`GausSimModule.optimise`).

    Torch's wrapper would reduce after every stretch of a rollout, wait for ranks that have no sequence, and give zero
    loss gradients to parameters of sequences that are in no batch.
    """

    def __init__(self, layout: Layout, run_dir: Path) -> None:
        super().__init__(process_group_backend=layout.backend, timeout=TIMEOUT)
        self._layout, self._run_dir = layout, run_dir

    def _configure_launcher(self) -> None:
        assert self.cluster_environment is not None
        if not self.cluster_environment.creates_processes_externally:
            self._launcher = FollowerLauncher(self.cluster_environment, self._layout, self._run_dir)

    def setup_distributed(self) -> None:
        """Joins the process group, if a scheduler's ranks have not yet."""
        if not dist.is_initialized():
            super().setup_distributed()
        reset_seed()
        self.set_world_ranks()

    def configure_ddp(self) -> None:
        """Copies the first rank's weights and buffers to all ranks."""
        assert self.model is not None
        for tensor in (*self.model.parameters(), *self.model.buffers()):
            dist.broadcast(tensor.detach(), src=0)


def claim_first(trainer: Mapping[str, Any]) -> None:
    """Makes this process the first rank where one is asked for, whatever variables a scheduler has left."""
    if trainer.get("devices", 1) == trainer.get("num_nodes", 1) == 1:
        rank_zero_only.rank = 0  # type: ignore[attr-defined]


@contextmanager
def joined(layout: Layout) -> Iterator[None]:
    """Context of a run: ranks that a scheduler has started meet at once, and the process group ends with the run.

    Raises:
        ConfigError: the layout does not fit this machine or the scheduler.
        RunError: another rank has ended or does not answer.
    """
    kept = {name: os.environ.get(name) for name in ("MASTER_ADDR", "MASTER_PORT")}
    try:
        if layout.size > 1:
            _check(layout)
        yield
    except RuntimeError as error:
        if isinstance(error, GausSimError) or not (isinstance(error, dist.DistError) or "gloo" in str(error).lower()):
            raise
        words = (str(error) or type(error).__name__).splitlines()[0]
        raise RunError(
            f"the connection to the other ranks is lost ({words}). One of them has ended or did not answer in "
            "time; its output states the reason. The last checkpoint, if any, is unharmed; the same command "
            "continues from it."
        ) from error
    finally:
        if dist.is_initialized():
            with suppress(RuntimeError):  # of ranks that have ended
                dist.destroy_process_group()
        for name, value in kept.items():  # torch's connection sets them; the next job of a sweep takes another port
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _check(layout: Layout) -> None:
    """Checks the devices, and joins ranks that a scheduler has started."""
    count = torch.cuda.device_count()
    if layout.on_gpu and layout.devices > count:
        raise ConfigError(
            f"trainer.devices: {layout.devices} ranks need as many GPUs, this machine has {count}. Set "
            "trainer.devices to that, or trainer.accelerator=cpu."
        )
    environment: ClusterEnvironment
    if TorchElasticEnvironment.detect():
        environment = TorchElasticEnvironment()
    elif int(os.environ.get("SLURM_NTASKS", "1")) > 1 and SLURMEnvironment.detect():
        environment = SLURMEnvironment(auto_requeue=False)
    elif layout.num_nodes > 1:
        raise ConfigError(
            f"trainer.num_nodes: {layout.num_nodes} machines need a scheduler that starts the ranks (SLURM with one "
            "task per rank, or torchrun), found none. See docs/how-to/gpus-and-clusters.md."
        )
    else:
        return
    if environment.world_size() != layout.size:
        raise ConfigError(
            f"trainer: the scheduler started {environment.world_size()} ranks, expected devices x num_nodes = "
            f"{layout.devices} x {layout.num_nodes}. Make tasks per node and trainer.devices equal, and the numbers of "
            "nodes."
        )
    dist.init_process_group(
        layout.backend, init_method=f"tcp://{environment.main_address}:{environment.main_port}",
        rank=environment.global_rank(), world_size=layout.size, timeout=TIMEOUT,
    )  # fmt: skip
