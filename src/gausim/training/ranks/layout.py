"""Number and placement of a run's ranks."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gausim.core import ConfigError


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
