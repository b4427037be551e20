"""Number and placement of a run's ranks, and their description for Lightning."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from lightning.fabric.utilities.seed import reset_seed
from lightning.pytorch.plugins.environments import LightningEnvironment
from lightning.pytorch.strategies import DDPStrategy
from torch import distributed as dist

from gausim.core import ConfigError

LOCALHOST = "127.0.0.1"


@dataclass(frozen=True)
class Layout:
    """Number of ranks (``devices`` are per machine), their devices and the time limit of their communication."""

    devices: int = 1
    num_nodes: int = 1
    accelerator: str = "auto"
    timeout_minutes: float = 10.0

    def __post_init__(self) -> None:
        if not all(isinstance(n, int) and n >= 1 for n in (self.devices, self.num_nodes)) or self.timeout_minutes <= 0:
            raise ConfigError(
                "trainer: expected devices >= 1, num_nodes >= 1 (numbers of ranks and machines) and "
                f"timeout_minutes > 0, got {self.devices!r}, {self.num_nodes!r} and {self.timeout_minutes!r}."
            )

    @property
    def size(self) -> int:
        """Number of all ranks."""
        return self.devices * self.num_nodes

    @property
    def on_gpu(self) -> bool:
        """Whether each rank has a GPU."""
        return self.accelerator in ("gpu", "cuda") or (self.accelerator == "auto" and torch.cuda.is_available())

    @property
    def backend(self) -> str:
        """Backend of torch.distributed for tensors on the device; the hosts always communicate by gloo."""
        return "cpu:gloo,cuda:nccl" if self.on_gpu else "gloo"


class LocalRanks(LightningEnvironment):
    """Lightning's cluster environment of a rank on this machine; it reads and sets no environment variable."""

    creates_processes_externally = True
    main_address = LOCALHOST

    def __init__(self, rank: int, size: int, port: int) -> None:
        super().__init__()
        self._global_rank, self._world_size, self._main_port = rank, size, port

    def local_rank(self) -> int:
        """Number of this rank, as all are on one machine."""
        return self._global_rank

    def node_rank(self) -> int:
        """0, the only machine."""
        return 0


class RanksStrategy(DDPStrategy):
    """Replicas whose loss gradients are added by the module (:meth:`GausSimModule.optimise`).

    Torch's wrapper would reduce after every stretch of a rollout, wait for ranks that have no sequence, and give zero
    loss gradients to parameters of sequences that are in no batch.
    """

    def _configure_launcher(self) -> None:
        """Sets no launcher: the ranks run already."""

    def setup_distributed(self) -> None:
        """Uses the process group of :class:`Crew`."""
        reset_seed()
        self.set_world_ranks()

    def configure_ddp(self) -> None:
        """Copies the first rank's weights and buffers to all ranks."""
        assert self.model is not None
        for tensor in (*self.model.parameters(), *self.model.buffers()):
            dist.broadcast(tensor.detach(), src=0)
