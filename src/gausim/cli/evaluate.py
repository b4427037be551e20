"""`gausim evaluate RUN`: measures a trained run on seen, unseen and held-out frames."""

from __future__ import annotations

import argparse
from pathlib import Path

from gausim.cli.arguments import add_data_option, command_parser, positive
from gausim.core.errors import ConfigError


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    if arguments.endurance is not None and arguments.endurance < 300:
        raise ConfigError(f"--endurance: expected at least 300 frames, got {arguments.endurance}.")
    from gausim.cli.evaluate_run import evaluate

    return evaluate(arguments)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("evaluate", " Writes metrics.json, metrics.npz, table.md and an error plot per object.")
    add = parser.add_argument
    add("run", metavar="RUN", type=Path, help="run directory of `gausim train`")
    add("--object", nargs="+", metavar="NAME", help="only these objects")
    add("--sequences", nargs="+", metavar="NAME", help="only these sequences (of every object)")
    add("--test", action="store_true", help="look at the test part of the data; counted in evaluation/test.json")
    add("--trials", type=positive, metavar="N", help="with --test: trials made of the method on the development part "
        "(default: protocol.trials of the run)")  # fmt: skip
    add("--views", default="all", choices=("all", "train", "heldout"), help="which cameras (default: all)")
    add("--flip", action="store_true", help="also measure FLIP (extra `flip`), in as much time as all other metrics")
    add_data_option(parser)
    add("--out", metavar="DIR", type=Path, help="folder to write; default RUN/evaluation, or RUN/evaluation/partial "
        "for a part")  # fmt: skip
    add(
        "--endurance", type=int, metavar="N",
        help="also roll N frames far, free and under random pushes in the first 240 (at least 300; 1000 is a good "
        "number); writes endurance.json and a figure per object",
    )  # fmt: skip
    add("--verbose", action="store_true", help="print all tables, and list the files that are written")
    add("--json", action="store_true", help="print metrics.json and nothing else")
    return parser
