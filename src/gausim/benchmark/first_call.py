"""The renderer's first call in a process of its own: time to compile or to load, and memory.

Run by ``gausim benchmark render`` as ``python -m gausim.benchmark.first_call COUNT SIZE``; prints one JSON object.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable

import torch

from gausim.benchmark.harness import peak_resident
from gausim.benchmark.splats import deformed, splats
from gausim.render.cpu import CpuRenderer
from gausim.render.draw import deformed_appearance


def measure(count: int, size: int) -> dict[str, float]:
    """Seconds of the first forward and backward pass, and of a second one, and bytes of resident memory.

    ``renderer`` and ``appearance`` are first calls of the renderer and of the colours and covariances of deformed
    kernels, each with its backward pass; imports are over by then.
    """
    torch.set_num_threads(1)
    x = torch.ones(2, requires_grad=True)
    torch.autograd.grad([2 * x], [x], [torch.ones(2)])  # torch imports more when it first differentiates anything
    scene, renderer = splats(count, size, size), CpuRenderer(threads=1)
    weights, imported = scene.weights(), peak_resident()
    found = {"renderer": _seconds(lambda: scene.both(renderer, weights))}
    found["again"] = _seconds(lambda: scene.both(renderer, weights))
    found["memory"], found["imports"] = float(peak_resident()), float(imported)
    found["appearance"] = _seconds(lambda: _appearance(count))
    return found


def _appearance(count: int) -> None:
    state = deformed(count, 1, 1, 1)
    positions, deformation_gradients, rotations = leaves = [value.requires_grad_() for value in state[:3]]
    look, unit = state.look, state.unit_of_kernel
    outputs = deformed_appearance(
        positions, deformation_gradients, rotations, unit, look.covars, look.sh, state.centers
    )
    torch.autograd.grad(outputs, leaves, [torch.ones_like(output) for output in outputs])


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def in_fresh_process(count: int, size: int, cache: str) -> dict[str, float]:
    """:func:`measure` in a new process with numba's cache in the folder ``cache``.

    Raises:
        subprocess.CalledProcessError: that process failed; what it said is on stderr.
    """
    command = [sys.executable, "-m", "gausim.benchmark.first_call", str(count), str(size)]
    environment = os.environ | {"NUMBA_CACHE_DIR": cache}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return dict(json.loads(done.stdout))


if __name__ == "__main__":
    print(json.dumps(measure(*(int(argument) for argument in sys.argv[1:]))))
