"""Training order: a pure function of seed and epoch, with a position from which a resumed run continues."""

from collections.abc import Iterator
from typing import Protocol

import torch
from torch.utils.data import Sampler

from gausim.core import ConfigError
from gausim.data.dataset import SampleKey


class Shows(Protocol):
    """The part of a training plan that data follow (:class:`gausim.training.plan.TrainingPlan`)."""

    @property
    def repeats(self) -> int:
        """Shows of each sequence per epoch."""

    @property
    def batch_size(self) -> int | None:
        """Sequences per optimiser step, divided among the ranks."""

    @property
    def t_max(self) -> int | None:
        """Most predicted frames."""

    def steps(self, epoch: int) -> int:
        """Predicted frames T in an epoch."""


class SequenceBatchSampler(Sampler[list[SampleKey]]):
    """Shows every sequence ``repeats`` times per epoch, in batches without a repeated sequence where possible.

    Lightning announces the epoch only to ``loader.sampler`` and ``loader.batch_sampler.sampler``; this object is
    therefore also its ``sampler``.

    The batches do not depend on the number of ranks: rank r takes the entries r, r + ranks, ... of each. All ranks take
    equally many steps; of a last batch with fewer sequences than ranks some ranks get no sequence, and no sequence is
    repeated to fill it. The trainer needs ``use_distributed_sampler=False``.
    """

    def __init__(
        self,
        count: int,
        *,
        plan: Shows,
        seed: int,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        """Divides ``count`` sequences into batches of the plan's size over all ranks.

        Raises:
            ConfigError: a number is out of range, or a batch has fewer sequences than ranks.
        """
        batch_size = plan.batch_size or 0
        if batch_size < world_size:
            raise ConfigError(
                f"plan.batch_size: expected at least one sequence for each of the {world_size} ranks, got {batch_size} "
                f"per optimiser step. Set plan.batch_size={world_size} or a multiple, or trainer.devices={batch_size}."
            )
        self._count, self._batch_size, self._plan, self._seed = count, batch_size, plan, seed
        self._rank, self._world_size = rank, world_size
        self.epoch = 0
        # One attribute, so that a cancelled iteration cannot change the position of the next epoch.
        self._dealt = (0, 0)

    @property
    def position(self) -> int:
        """Batches already returned in the current epoch."""
        epoch, dealt = self._dealt
        return dealt if epoch == self.epoch else 0

    @property
    def sampler(self) -> "SequenceBatchSampler":
        """The object itself; Lightning calls its ``set_epoch``."""
        return self

    def set_epoch(self, epoch: int) -> None:
        """Starts an epoch; the current epoch (after a resume) keeps its position."""
        if epoch != self.epoch:
            self.epoch, self._dealt = epoch, (epoch, 0)

    def __len__(self) -> int:
        """Number of batches per epoch."""
        return -(-self._count * self._plan.repeats // self._batch_size)

    def order(self, epoch: int) -> list[int]:
        """Sequence ids of an epoch.

        Permutations are concatenated; the head of each avoids sequences that are already in the unfinished batch.
        """
        generator = torch.Generator().manual_seed(hash_seed(self._seed, epoch))
        order: list[int] = []
        for _ in range(self._plan.repeats):
            permutation = torch.randperm(self._count, generator=generator).tolist()
            open_batch = set(order[len(order) - len(order) % self._batch_size :])
            order += [i for i in permutation if i not in open_batch] + [i for i in permutation if i in open_batch]
        return order

    def __iter__(self) -> Iterator[list[SampleKey]]:
        """Yields this rank's slice of each batch from the current position on; it may be empty."""
        epoch, position, size = self.epoch, self.position, self._batch_size
        steps, order = self._plan.steps(epoch), self.order(epoch)
        batches = [order[i : i + size][self._rank :: self._world_size] for i in range(0, len(order), size)]
        for number in range(position if position < len(batches) else 0, len(batches)):
            self._dealt = (epoch, number + 1)
            yield [SampleKey(sequence, steps) for sequence in batches[number]]
        self._dealt = (epoch, 0)

    def state_dict(self) -> dict[str, int]:
        """Epoch and number of batches already returned in it."""
        return {"epoch": self.epoch, "position": self.position}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Continues from ``state``."""
        self.epoch = int(state["epoch"])
        self._dealt = (self.epoch, int(state["position"]))


def hash_seed(seed: int, epoch: int) -> int:
    """One 63-bit seed from two numbers, without the overlap that ``seed + epoch`` has between neighbouring seeds."""
    return (seed * 0x9E3779B97F4A7C15 + epoch * 0xBF58476D1CE4E5B9 + 0x94D049BB133111EB) % (1 << 63)
