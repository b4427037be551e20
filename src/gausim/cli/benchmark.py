"""`gausim benchmark`: speed of the renderer, the step, training and clustering on this machine."""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from typing import TYPE_CHECKING, Any

from gausim.cli.arguments import command_parser, positive
from gausim.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from gausim.benchmark.harness import Options, Row
    from gausim.core import GaussianScene
    from gausim.models.step.simulator import GausSim

CASES = {
    "render": "the CPU renderer against plain torch, threads, views, compilation",
    "step": "one predicted frame at the paper's size, with and without hierarchy, and of the other models",
    "train": "whole optimiser steps, part by part, against elastic ones; KEY=VALUE as in `gausim train`",
    "data": "packed frames against decoding PNG; opening and streaming a set of the paper's size",
    "interact": "an object that is pushed about: simulated frames per second, from the force to the browser's bytes",
    "cluster": "clusters of bounded diameter, against scipy",
}
DEFAULT_OVERRIDES = ("experiment=demo", "model=gausim")
RIVAL = "model=gausim_elastic"  # reference for the speed of training


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_intermixed_args(argv)  # KEY=VALUE may follow an option
    import torch

    from gausim.benchmark.harness import Options, machine, torch_threads

    options = Options(_device(arguments.device), arguments.threads, arguments.quick, arguments.rounds)
    torch.manual_seed(0)
    rows: list[Row] = []
    with torch_threads(options.threads):
        described = machine(options)
        if not arguments.json:
            print("\n".join(f"{key:<10} {value}" for key, value in described.items()), flush=True)
        for name in CASES if arguments.case == "all" else [arguments.case]:
            print(f"measuring {name} ...", file=sys.stderr, flush=True)
            made = _run(name, options, arguments.overrides, optional=arguments.case == "all")
            rows += made
            if not arguments.json:
                _print(name, made)
    if arguments.json:
        print(json.dumps({"machine": described, "rows": [vars(row) for row in rows]}, indent=1))
    return 0


def _parser() -> argparse.ArgumentParser:
    cases = "\n".join(f"  {name:<9} {text}" for name, text in CASES.items())
    parser = command_parser(
        "benchmark",
        f"\n\ncases:\n{cases}\n  all       all of them",
        epilog="docs/results.md has tables of one machine. Close everything else first: single times drift "
        "with the machine's load, ratios within one run hold.",
    )
    add = parser.add_argument
    add("case", choices=[*CASES, "all"], metavar="CASE", help="one of the cases above, or all")
    add("overrides", nargs="*", metavar="KEY=VALUE",
        help=f"training configuration of the case train; default {' '.join(DEFAULT_OVERRIDES)}")  # fmt: skip
    add("--json", action="store_true", help='print one JSON object: {"machine": ..., "rows": [...]}')
    add("--quick", action="store_true", help="tiny sizes: to see that it works, not to quote")
    add("--threads", type=positive, default=1, help="threads of torch and the renderer; default %(default)s")
    add("--rounds", type=positive, default=7, help="timed calls of each candidate; default %(default)s")
    add("--device", default="cpu", help="cpu, cuda or cuda:N; default %(default)s")
    return parser


def _device(name: str) -> Any:
    import torch

    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"--device {name}: expected cpu, cuda or cuda:N.") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"--device {name}: torch {torch.__version__} sees no CUDA device. Use --device cpu.")
    return device


def _run(name: str, options: Options, overrides: list[str], *, optional: bool) -> list[Row]:
    case = importlib.import_module(f"gausim.benchmark.{name}")
    if name in ("step", "interact"):
        return list(case.run(options, simulator_of))
    if name != "train":
        return list(case.run(options))
    from gausim.compose.build import build
    from gausim.compose.config import compose

    overrides = overrides or list(DEFAULT_OVERRIDES)
    config = compose("train", overrides)
    rival = compose("train", [*(word for word in overrides if not word.startswith(("model=", "model."))), RIVAL])
    try:
        module, datamodule = build(config)
        others = {} if config.model == rival.model else {RIVAL: build(rival)[0]}
    except DataError as error:
        if not optional:
            raise
        print(f"train left out: {error}", file=sys.stderr)
        return []
    return list(case.run(options, module, datamodule, others))


def simulator_of(preset: str, scene: GaussianScene, *settings: str) -> GausSim:
    """The untrained simulator of ``conf/model/PRESET.yaml`` for a scene at 24 frames per second, with KEY=VALUE."""
    from gausim.compose.config import compose, instantiate

    config = compose(f"model/{preset}", [f"model.simulator.{setting}" for setting in settings])
    made: GausSim = instantiate(config.model.simulator)(scenes=[scene], fps=[24.0])
    return made


def _print(name: str, rows: list[Row]) -> None:
    print(f"\n{name}")
    cases = max((len(row.case) for row in rows), default=0)
    metrics = max((len(row.metric) for row in rows), default=0)
    for row in rows:
        reference = f"  ({row.reference})" if row.reference else ""
        value, unit = _readable(row.value, row.unit)
        print(f"  {row.case:<{cases}}  {row.metric:<{metrics}}  {value:>9} {unit}{reference}", flush=True)


def _readable(value: float, unit: str) -> tuple[str, str]:
    """A figure with three significant digits, and its unit with an SI prefix if it takes one."""
    if unit == "s" and value < 1:
        return f"{1000 * value:.3g}", "ms"
    if unit == "B":
        for power, prefix in ((9, "G"), (6, "M"), (3, "k")):
            if value >= 10**power:
                return f"{value / 10**power:.3g}", prefix + unit
    return (f"{value:.0f}" if value >= 1000 else f"{value:.3g}"), "" if unit == "1" else unit
