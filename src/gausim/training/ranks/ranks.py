"""Communication between the ranks of a training run: gathering of values, sums of loss gradients, decisions.

Every rank has the whole model and computes a part of a step's sequences. Values are added, not averaged: each rank
divides its losses by the whole step's number of sequences, so the sums over ranks equal the step of a single rank.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch import distributed as dist

from gausim.core import RunError

T = TypeVar("T")


class Ranks:
    """The ranks of torch's process group, or this process alone where there is none.

    The methods are collective: all ranks must call them in the same order. In a single process they return at once.
    """

    @property
    def size(self) -> int:
        """Number of ranks."""
        return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1

    @property
    def rank(self) -> int:
        """Number of this rank; rank 0 writes the files."""
        return dist.get_rank() if self.size > 1 else 0

    def gather(self, value: T) -> list[T]:
        """The values of all ranks, in rank order; for small plain data."""
        if self.size == 1:
            return [value]
        found: list[Any] = [None] * self.size
        dist.all_gather_object(found, value)
        return found

    def first(self, function: Callable[[], T]) -> T:
        """Result of a function that only the first rank calls; an error there is a RunError on the other ranks."""
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

    def add(self, tensors: Sequence[Tensor | None], like: Sequence[Tensor]) -> list[Tensor | None]:
        """Sums of tensors over ranks, one message per data type; the same bits on every rank.

        None counts as zero, and stays None where no rank has a tensor; ``like`` has the shapes, types and device.
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
        """Raises RunError where a fingerprint differs between ranks, which then no longer train one model."""
        found = self.gather(fingerprint)
        different = [rank for rank, text in enumerate(found) if text != found[0]]
        if different:
            raise RunError(
                f"{what}: expected the same on all ranks, but ranks {different} differ from the first. The last "
                "checkpoint is from before; start the same command again, with equal machines and libraries."
            )


def interleave(slices: Sequence[Sequence[T]]) -> list[T]:
    """A step's sequences in order, from the ranks' slices: rank r has items r, r + ranks, r + 2 ranks, ..."""
    length = max(map(len, slices))
    return [rank_slice[i] for i in range(length) for rank_slice in slices if i < len(rank_slice)]
