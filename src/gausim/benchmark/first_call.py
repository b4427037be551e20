"""Benchmark of the renderer's first call in a new process: time to compile or to load, and memory.

``gausim benchmark render`` runs ``python -m gausim.benchmark.first_call COUNT SIZE``, which prints one JSON object.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

import torch

from gausim.benchmark.harness import peak_resident, seconds_of
from gausim.benchmark.splats import deformed, gradients, splats
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import deformed_appearance


def measure(count: int, size: int) -> dict[str, float]:
    """Time of the first forward and backward pass [s] and resident memory [bytes].

    ``renderer`` and ``appearance`` are first calls of the renderer and of the colours and covariances of deformed
    kernels, each with its backward pass, after all imports.
    """
    torch.set_num_threads(1)
    x, cpu = torch.ones(2, requires_grad=True), torch.device("cpu")
    torch.autograd.grad([2 * x], [x], [torch.ones(2)])  # torch imports more when it first differentiates anything
    scene, renderer, state = splats(count, size, size), CpuRenderer(threads=1), deformed(count, 1, 1, 1)
    weights, imported = scene.weights(), float(peak_resident())
    seconds = seconds_of(lambda: scene.both(renderer, weights), cpu)
    memory = float(peak_resident())
    appearance = seconds_of(lambda: gradients(deformed_appearance, state), cpu)
    return {"renderer": seconds, "memory": memory, "imports": imported, "appearance": appearance}


def in_fresh_process(count: int, size: int, cache: str) -> dict[str, float]:
    """:func:`measure` in a new process with numba's cache in the folder ``cache``.

    Raises:
        subprocess.CalledProcessError: the process failed; its output is on stderr.
    """
    command = [sys.executable, "-m", "gausim.benchmark.first_call", str(count), str(size)]
    environment = os.environ | {"NUMBA_CACHE_DIR": cache}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return dict(json.loads(done.stdout))


if __name__ == "__main__":
    print(json.dumps(measure(*(int(argument) for argument in sys.argv[1:]))))
