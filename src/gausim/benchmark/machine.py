"""What the figures were measured on."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import numba
import torch

from gausim import __version__
from gausim.benchmark.harness import Options
from gausim.benchmark.peaks import peaks


def processor() -> str:
    """The processor's name, as the system gives it."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def machine(options: Options) -> dict[str, str]:
    """Processor, device, software and the peaks measured now."""
    best = peaks(options)
    rates = [f"matrix product {best.gemm / 1e9:.0f} GFLOP/s", f"copy {best.copy / 1e9:.1f} GB/s"]
    if best.fma:
        rates.insert(0, f"fused multiply-add {best.fma / 1e9:.0f} GFLOP/s")
    described = {
        "processor": f"{processor()}, {os.cpu_count()} logical cores, {torch.backends.cpu.get_cpu_capability()}",
        "system": f"{platform.system()} {platform.machine()}",
        "software": f"gausim {__version__}, Python {platform.python_version()}, torch {torch.__version__}, "
        f"numba {numba.__version__}",
        "threads": str(options.threads),
        "peaks": ", ".join(rates),
        "sizes": "quick (not to be quoted)" if options.quick else "full",
    }
    if options.device.type == "cuda":
        described["device"] = torch.cuda.get_device_name(options.device)
    return described
