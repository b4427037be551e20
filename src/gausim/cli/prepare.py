"""`gausim prepare WHAT`: makes data sets from films or photos or synthetically, and fetches LPIPS weights."""

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

import gausim
from gausim.cli.arguments import command_parser
from gausim.core.errors import ConfigError

# Modules of data_prep, with one line of help each.
STAGES = {
    "ingest": "synchronise the films of several cameras into frames",
    "poses": "find the poses of photos and fixed cameras by COLMAP, or take them over",
    "segment": "cut the object out of pictures or films",
    "select": "mark the kernels that are simulated, pinned and compared",
    "assemble": "assemble stills, sequences and scene of one object into a data set",
    "pack": "pack a data set's sequences for streaming",
    "public": "bring a public set to our layout: READY, Spring-Gaus, PhysDreamer",
    "synthesize": "make the embedded synthetic set: puddings and flowers that MuJoCo moves",
    "blender_bunny": "make the paper's synthetic set: any mesh as a soft body of Blender",
    "lpips": "fetch the LPIPS weights, so that evaluations measure LPIPS",
}


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit status."""
    stage = argv[0].replace("-", "_") if argv else ""
    if stage in STAGES:
        root = str(stages_root())
        if root not in sys.path:
            sys.path.insert(0, root)
        status: int = importlib.import_module(f"data_prep.{stage}").main(list(argv[1:]))
        return status
    _parser().parse_args(argv)
    return 0


def stages_root() -> Path:
    """The folder that holds the package ``data_prep``: in the wheel, or in the checkout."""
    package = Path(gausim.__file__).resolve().parent
    candidates = (package / "stages", package.parents[1])
    for candidate in candidates:
        if (candidate / "data_prep" / "__init__.py").is_file():
            return candidate
    raise ConfigError(
        f"expected the stages in {candidates[0] / 'data_prep'} or {candidates[1] / 'data_prep'}, found neither. "
        "Reinstall gausim, or run from a complete checkout."
    )


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("prepare", epilog="`gausim prepare WHAT --help` explains each.")
    parts = parser.add_subparsers(metavar="WHAT", required=True)
    for name, line in STAGES.items():
        parts.add_parser(name, help=line, add_help=False)
    return parser
