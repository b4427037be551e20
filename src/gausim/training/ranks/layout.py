"""Number and placement of a run's ranks."""

from dataclasses import dataclass

import torch

from gausim.core import ConfigError


@dataclass(frozen=True)
class Layout:
    """Number of ranks (``devices`` are per machine) and their devices."""

    devices: int = 1
    num_nodes: int = 1
    accelerator: str = "auto"

    def __post_init__(self) -> None:
        if not all(isinstance(n, int) and n >= 1 for n in (self.devices, self.num_nodes)):
            raise ConfigError(
                "trainer: expected devices >= 1 and num_nodes >= 1 (numbers of ranks and machines), got "
                f"{self.devices!r} and {self.num_nodes!r}."
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
