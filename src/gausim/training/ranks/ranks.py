"""What the processes of one training run do together: gather numbers, add gradients, agree.

Every rank holds the whole model and takes its share of the sequences of a step. Nothing here is averaged: each rank
weighs its own part by the whole step's number of sequences, so sums over ranks are the step of one rank.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch import distributed as dist

from gausim.core import GausSimError, RunError

T = TypeVar("T")


class Ranks:
    """The processes that train together, or this one alone where torch's process group is not up.

    What every rank calls must be called by all in the same order; a process that is alone goes straight through.
    """

    @property
    def size(self) -> int:
        """How many there are."""
        return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1

    @property
    def rank(self) -> int:
        """The number of this one; 0 is the one that writes."""
        return dist.get_rank() if self.size > 1 else 0

    def gather(self, value: T) -> list[T]:
        """The values of all ranks, in their order; small plain data."""
        if self.size == 1:
            return [value]
        found: list[Any] = [None] * self.size
        dist.all_gather_object(found, value)
        return found

    def first(self, function: Callable[[], T]) -> T:
        """What a function returns that only the first rank calls; what it raises, the others raise as a RunError."""
        if self.size == 1:
            return function()
        answer: list[Any] = [None, None]
        failure: BaseException | None = None
        if self.rank == 0:
            try:
                answer[0] = function()
            except BaseException as error:
                failure, answer[1] = error, f"{type(error).__name__}: {error}"
        dist.broadcast_object_list(answer, src=0)
        if failure is not None:
            raise failure
        if answer[1] is not None:
            raise RunError(f"rank {self.rank}: the first rank stopped ({answer[1]}).")
        return answer[0]

    def everywhere(self, flag: Tensor) -> Tensor:
        """Whether a boolean tensor on the device is true on all ranks; the host does not wait for it."""
        if self.size == 1:
            return flag
        least = flag.to(torch.int32)
        dist.all_reduce(least, dist.ReduceOp.MIN)
        return least.bool()

    def add(self, tensors: Sequence[Tensor | None], like: Sequence[Tensor]) -> list[Tensor | None]:
        """Sums of tensors over ranks, all of one type in one message: the same bits on every rank.

        None counts as zero, and where no rank has a tensor there is none; ``like`` has the shapes, types and device.
        """
        if self.size == 1:
            return list(tensors)
        held = self.gather(bytes(t is not None for t in tensors))
        present = [i for i in range(len(like)) if any(mask[i] for mask in held)]
        sums: list[Tensor | None] = [None] * len(like)
        for dtype in sorted({like[i].dtype for i in present}, key=str):
            places = [i for i in present if like[i].dtype == dtype]
            parts = [torch.zeros_like(like[i]) if tensors[i] is None else tensors[i] for i in places]
            flat = torch.cat([part.detach().reshape(-1) for part in parts if part is not None])
            dist.all_reduce(flat)
            for i, piece in zip(places, flat.split([like[i].numel() for i in places]), strict=True):
                sums[i] = piece.view(like[i].shape)
        return sums

    def check_alike(self, fingerprint: str, what: str) -> None:
        """Raises RunError where a text is not the same everywhere: drifted ranks no longer train one model."""
        found = self.gather(fingerprint)
        different = [rank for rank, text in enumerate(found) if text != found[0]]
        if different:
            raise RunError(
                f"{what}: expected the same on all ranks, but ranks {different} differ from the first. The last "
                "checkpoint is from before; start the same command again, with equal machines and libraries."
            )


def interleave(shares: Sequence[Sequence[T]]) -> list[T]:
    """The order of a step's sequences from the ranks' shares: rank r holds places r, r + ranks, r + 2 ranks, ..."""
    length = max(map(len, shares))
    return [share[i] for i in range(length) for share in shares if i < len(share)]


def is_lost_connection(error: BaseException) -> bool:
    """Whether an error says that another rank is gone, or did not answer in time."""
    if isinstance(error, GausSimError):
        return False
    return isinstance(error, dist.DistError) or (isinstance(error, RuntimeError) and "gloo" in str(error).lower())
