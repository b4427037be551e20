"""Reads ahead of the training by a bounded number of batches, so that the disk works while the processor does."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from gausim.core import ConfigError

T = TypeVar("T")


class PrefetchingLoader(DataLoader):
    """A loader whose next batches are read by one thread while the current one is trained on.

    In memory are the batch in use and at most ``prefetch`` more, the one that is being read included. Order and content
    are those of a loader that does not read ahead.
    """

    def __init__(
        self,
        dataset: Dataset,
        *,
        batch_sampler: Sampler[list[Any]],
        collate_fn: Callable[[list[Any]], Any],
        prefetch: int,
    ) -> None:
        """Serves the batches of ``batch_sampler``.

        Args:
            dataset: where samples come from.
            batch_sampler: which ones make a batch.
            collate_fn: makes a batch of them.
            prefetch: batches read ahead; 0 reads each when it is asked for.

        Raises:
            ConfigError: ``prefetch`` is negative.
        """
        if prefetch < 0:
            raise ConfigError(f"data.prefetch: expected 0 or more batches read ahead, got {prefetch}.")
        super().__init__(
            dataset,
            batch_sampler=batch_sampler,
            collate_fn=collate_fn,
            num_workers=0,
            # The loader draws a number per epoch; from the global generator, a resumed run would draw another count.
            generator=torch.Generator(),
        )
        self.prefetch = prefetch
        self._open: Generator[Any, None, None] | None = None

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        """The batches; what an iteration before this one was still reading ahead is given up."""
        if self._open is not None:
            self._open.close()
        self._open = read_ahead(super().__iter__(), self.prefetch) if self.prefetch else None
        return self._open or super().__iter__()


@dataclass(frozen=True)
class _Ended:
    """The source has no more items, or has failed."""

    error: BaseException | None


def read_ahead(source: Iterator[T], most: int) -> Generator[T, None, None]:
    """The items of ``source``, at most ``most`` of them read before they are asked for.

    Closing the generator ends the thread that reads.

    Raises:
        BaseException: what ``source`` raised, at the item where it did.
    """
    permits, ready, stop = threading.Semaphore(most), queue.SimpleQueue[T | _Ended](), threading.Event()

    def read() -> None:
        try:
            while permits.acquire() and not stop.is_set():
                ready.put(next(source))
        except StopIteration:
            ready.put(_Ended(None))
        except BaseException as error:  # whatever it is, it belongs to the thread that asks
            ready.put(_Ended(error))

    thread = threading.Thread(target=read, name="gausim-prefetch", daemon=True)
    thread.start()
    try:
        while not isinstance(item := ready.get(), _Ended):
            permits.release()
            yield item
            del item  # not held while the next one is waited for
        if item.error is not None:
            raise item.error
    finally:
        stop.set()
        permits.release()
        thread.join()
