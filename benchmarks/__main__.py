"""`python -m benchmarks CASE` (`make benchmark ARGS=CASE`): speed and memory on this machine."""

from __future__ import annotations

import argparse
import importlib
import json
import platform
import sys
from importlib.metadata import version

import torch

from benchmarks.harness import Options, Row
from gausim import __version__
from gausim.core import DataError, GausSimError
from gausim.core.errors import sentence
from gausim.runs import provenance

CASES = {
    "render": "the CPU renderer against plain torch, threads, views, compilation",
    "step": "one predicted frame at the paper's size, with and without hierarchy, and of the other models",
    "train": "whole optimiser steps, part by part; KEY=VALUE as in `gausim train`",
    "scale": "a training at the paper's size, stage by stage, and the whole for 30 sequences; KEY=VALUE likewise",
    "teach": "single steps and rollouts of the pure network on tracked motion: pairs per second",
    "data": "packed frames against decoding PNG; opening and streaming a set of the paper's size",
    "interact": "an object that is pushed: simulated frames per second, from the force to the browser's bytes",
    "cluster": "clusters of bounded diameter, against scipy",
}


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_intermixed_args(argv)
    options = Options(torch.device(arguments.device), arguments.threads, arguments.quick, arguments.rounds)
    torch.manual_seed(0)
    torch.set_num_threads(options.threads)
    rows: list[Row] = []
    for name in CASES if arguments.case == "all" else [arguments.case]:
        print(f"measuring {name} ...", file=sys.stderr, flush=True)
        more = {"overrides": arguments.overrides} if name in ("train", "scale") else {}
        try:
            rows += importlib.import_module(f"benchmarks.{name}").run(options, **more)
        except DataError as error:
            if arguments.case != "all":
                raise
            print(f"{name} left out: {error}", file=sys.stderr)
    if arguments.json:
        print(json.dumps({"machine": machine(options), "rows": [vars(row) for row in rows]}, indent=1))
        return 0
    print("\n".join(f"{key:<10} {value}" for key, value in machine(options).items()))
    for row in rows:
        reference = f"  ({row.reference})" if row.reference else ""
        print(f"  {row.case:<52}  {row.metric:<40}  {row.value:>9.4g} {row.unit}{reference}")
    return 0


def machine(options: Options) -> dict[str, str]:
    """Processor and software of the benchmark."""
    return {
        "processor": f"{provenance.machine()}, {torch.backends.cpu.get_cpu_capability()}, {options.device}",
        "software": f"gausim {__version__}, Python {platform.python_version()}, torch {torch.__version__}, "
        f"numba {version('numba')}",
        "threads": str(options.threads),
        "sizes": "quick (not to be quoted)" if options.quick else "full",
    }


def _parser() -> argparse.ArgumentParser:
    cases = "\n".join(f"  {name:<9} {text}" for name, text in CASES.items())
    parser = argparse.ArgumentParser(
        "python -m benchmarks",
        description=f"Measure speed and memory as ratios within one run.\n\ncases:\n{cases}\n  all       all of them",
        epilog="Close everything else first: single times drift with the machine's load, ratios within one run hold.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("case", choices=[*CASES, "all"], metavar="CASE", help="one of the cases above, or all")
    add("overrides", nargs="*", metavar="KEY=VALUE", help="training configuration of the cases train and scale")
    add("--json", action="store_true", help='print one JSON object: {"machine": ..., "rows": [...]}')
    add("--quick", action="store_true", help="tiny sizes: to see that it works, not to quote")
    add("--threads", type=int, default=1, help="threads of torch and the renderer; default %(default)s")
    add("--rounds", type=int, default=7, help="timed calls of each candidate; default %(default)s")
    add("--device", default="cpu", help="cpu, cuda or cuda:N; default %(default)s")
    return parser


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except GausSimError as error:
        sys.exit(f"error: {sentence(error)}")
