"""Reads a bounded number of batches ahead of training, so that reading and computing overlap."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
from torch.utils.data import DataLoader, Dataset

from gausim.core import ConfigError

T = TypeVar("T")


class PrefetchingLoader(DataLoader):
    """A loader that reads the next batches in one thread while the current one is trained on.

    A thread is used instead of a worker process because validation uses the same cache of decoded images. Order and
    content equal those of a loader that does not read ahead.
    """

    def __init__(self, dataset: Dataset, *, prefetch: int, **options: Any) -> None:
        """A ``DataLoader`` with these ``options``; ``prefetch`` batches are read ahead, 0 reads each on request.

        Raises:
            ConfigError: ``prefetch`` is negative.
        """
        if prefetch < 0:
            raise ConfigError(f"data.prefetch: expected 0 or more batches read ahead, got {prefetch}.")
        # The loader draws one number per epoch; from the global generator, a resumed run would draw a different count.
        super().__init__(dataset, generator=torch.Generator(), **options)
        self.prefetch = prefetch
        self._open: Generator[Any, None, None] | None = None

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        """The batches; an earlier iteration that still reads ahead is cancelled."""
        if self._open is not None:
            self._open.close()
        self._open = read_ahead(super().__iter__(), self.prefetch) if self.prefetch else None
        return self._open or super().__iter__()


def read_ahead(source: Iterator[T], most: int) -> Generator[T, None, None]:
    """The items of ``source``, up to ``most`` of them read in advance; errors are raised at the item that caused them.

    Closing the generator ends the reading thread.
    """
    end = object()
    pool = ThreadPoolExecutor(1, thread_name_prefix="gausim-prefetch")
    try:
        ahead = deque(pool.submit(next, source, end) for _ in range(most))
        while (item := ahead.popleft().result()) is not end:
            ahead.append(pool.submit(next, source, end))
            yield item  # type: ignore[misc]
            del item  # free its memory while waiting for the next one
    finally:
        pool.shutdown(cancel_futures=True)
