"""`gausim evaluate RUN`: measures a trained run on seen, unseen and held-out frames."""

import argparse
from pathlib import Path

from gausim.cli.arguments import add_data_option, add_device_options, add_names, command_parser, computing, positive


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    from gausim.cli.evaluate_run import evaluate

    computing(arguments)
    return evaluate(arguments)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "evaluate", " Writes metrics.json, metrics.npz, table.md, and a film and an error plot per object."
    )
    add = parser.add_argument
    add("run", metavar="RUN", type=Path, help="run directory of `gausim train`")
    add_names(parser, "objects", "measure these objects (default: all)")
    add_names(parser, "sequences", "measure these sequences of every object (default: all)")
    add("--cameras", default="all", choices=("all", "train", "heldout"), help="measure in these (default: all)")
    add("--test", action="store_true", help="evaluate the test part; evaluation/test.json counts it")
    add("--trials", type=positive, metavar="N", help="declare N trials of the method on the development "
        "part, with --test (default: trials of the run)")  # fmt: skip
    add_data_option(parser)
    add("--out", metavar="DIR", type=Path, help="write to this folder (default: RUN/evaluation, of a part "
        "RUN/evaluation/partial)")  # fmt: skip
    add_device_options(parser)
    add("--verbose", action="store_true", help="print all tables, and list the files that are written")
    add("--json", action="store_true", help="print metrics.json and nothing else")
    return parser
