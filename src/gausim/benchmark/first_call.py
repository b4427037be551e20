"""Benchmark of the renderer's first call in a new process: time to compile or to load.

``gausim benchmark render`` runs ``python -m gausim.benchmark.first_call COUNT SIZE``, which prints the seconds.
"""

from __future__ import annotations

import os
import subprocess
import sys

import torch

from gausim.benchmark.harness import seconds_of
from gausim.benchmark.splats import splats
from gausim.render.cpu import CpuRenderer


def measure(count: int, size: int) -> float:
    """Time of the first forward and backward pass after all imports [s]."""
    torch.set_num_threads(1)
    x, cpu = torch.ones(2, requires_grad=True), torch.device("cpu")
    torch.autograd.grad([2 * x], [x], [torch.ones(2)])  # torch imports more when it first differentiates anything
    scene, renderer = splats(count, size, size), CpuRenderer(threads=1)
    weights = scene.weights()
    return seconds_of(lambda: scene.both(renderer, weights), cpu)


def in_fresh_process(count: int, size: int, cache: str) -> float:
    """:func:`measure` in a new process with numba's cache in the folder ``cache``.

    Raises:
        subprocess.CalledProcessError: the process failed; its output is on stderr.
    """
    command = [sys.executable, "-m", "gausim.benchmark.first_call", str(count), str(size)]
    environment = os.environ | {"NUMBA_CACHE_DIR": cache}
    return float(subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout)


if __name__ == "__main__":
    print(measure(*(int(argument) for argument in sys.argv[1:])))
