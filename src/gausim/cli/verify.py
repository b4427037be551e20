"""`gausim verify`: lists all faults of a data set."""

import argparse
import json
from pathlib import Path

from gausim.cli.arguments import command_parser


def main(argv: list[str]) -> int:
    """Runs the command; returns 1 if there are faults, else 0."""
    arguments = _parser().parse_args(argv)
    from gausim.data.objects import find_objects
    from gausim.data.verify import verify

    roots = [found for root in arguments.root for found in find_objects(root)]
    faults = {str(root): verify(root, quick=arguments.quick) for root in roots}
    if arguments.json:
        print(json.dumps({root: [[f.where, f.what] for f in found] for root, found in faults.items()}, indent=1))
    else:
        for root, found in faults.items():
            print(f"{root}: {'ok' if not found else f'{len(found)} faults'}")
            for fault in found:
                print(f"  {fault.where}: {fault.what}")
    return 1 if any(faults.values()) else 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("verify", " Exits with 1 if there are some.")
    parser.add_argument("root", metavar="ROOT", nargs="+", type=Path, help="object directories, or folders of them")
    parser.add_argument("--quick", action="store_true", help="check headers and sizes only, without reading an image")
    parser.add_argument("--json", action="store_true", help="print an object: {DIRECTORY: [[file, fault], ...]}")
    return parser
