"""Peak rates of the machine, measured in the same run as the fractions of them."""

# Annotations would make beartype, in tests, wrap a function that numba compiles.
# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"
from __future__ import annotations

import functools
import platform
from dataclasses import dataclass

import numba
import numpy as np
import torch

from gausim import __version__
from gausim.benchmark.harness import Options, medians, seconds_of, torch_threads
from gausim.kernels.pool import WorkerPool
from gausim.runs import provenance

# Independent accumulators: enough vectors of any width to hide the latency of a fused multiply-add.
LANES = 192
ROUNDS = 400_000
GEMM_SIZE = {True: 512, False: 1024}
COPY_BYTES = 256 << 20  # far beyond any cache
TRIES = 7


@dataclass(frozen=True)
class Peaks:
    """Peak rates for one number of threads on one device."""

    fma: float  # float32 fused multiply-adds in registers [FLOP/s], one CPU thread; 0 on a GPU
    gemm: float  # float32 matrix product [FLOP/s]
    copy: float  # bytes read plus bytes written by a copy much larger than the caches [B/s]


def _make_fma_loop():
    @numba.njit(nogil=True, fastmath=True, error_model="numpy", cache=True)
    def loop(values, scale, shift, rounds):
        a = np.empty(LANES, np.float32)  # a local array of known length stays in vector registers
        for i in range(LANES):
            a[i] = values[i]
        for _ in range(rounds):
            for i in range(LANES):
                a[i] = a[i] * scale + shift
        for i in range(LANES):
            values[i] = a[i]

    return loop


_fma_loop = _make_fma_loop()


def fma_peak(threads: int = 1) -> float:
    """Twice the fused multiply-adds per second of ``threads`` threads together [FLOP/s]."""
    scale, shift = np.float32(0.9999), np.float32(1e-4)

    def loop(rounds: int) -> None:
        _fma_loop(np.ones(LANES, np.float32), scale, shift, rounds)

    loop(1)
    pool, cpu = WorkerPool(threads), torch.device("cpu")
    best = min(seconds_of(lambda: pool.run(loop, [ROUNDS] * threads), cpu) for _ in range(TRIES))
    return 2.0 * LANES * ROUNDS * threads / best


@functools.cache
def peaks(options: Options) -> Peaks:
    """The three rates, measured once per process and set of options."""
    size = GEMM_SIZE[options.quick] * (8 if options.device.type == "cuda" else 1)
    a, b, out = torch.randn(3, size, size, device=options.device)
    source, target = torch.zeros(2, COPY_BYTES // 4, device=options.device)
    with torch_threads(options.threads):
        calls = {"gemm": lambda: torch.mm(a, b, out=out), "copy": lambda: target.copy_(source)}
        times = medians(calls, options)
        fma = fma_peak() if options.device.type == "cpu" else 0.0
    return Peaks(fma, 2.0 * size**3 / times["gemm"], 2.0 * COPY_BYTES / times["copy"])


def machine(options: Options) -> dict[str, str]:
    """Processor, device and software of the benchmark, with the peaks measured now."""
    best = peaks(options)
    rates = [f"fused multiply-add {best.fma / 1e9:.0f} GFLOP/s"] if best.fma else []
    rates += [f"matrix product {best.gemm / 1e9:.0f} GFLOP/s", f"copy {best.copy / 1e9:.1f} GB/s"]
    described = {
        "processor": f"{provenance.machine()}, {torch.backends.cpu.get_cpu_capability()}",
        "system": f"{platform.system()} {platform.machine()}",
        "software": f"gausim {__version__}, Python {platform.python_version()}, torch {torch.__version__}, "
        f"numba {numba.__version__}",
        "threads": str(options.threads),
        "peaks": ", ".join(rates),
        "sizes": "quick (not to be quoted)" if options.quick else "full",
    }
    return described
