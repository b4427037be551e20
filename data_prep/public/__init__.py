"""Bring public data sets of elastic objects to our layout, checked as `gausim verify` does.

Gravity and floor come along where a set has them; stills are frame 0 of the cameras where it has none. Objects
without masks are to be segmented next. What deviates from a set's layout is refused with file and field.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

from data_prep.common.command import add_options, chosen, headline, run_command, stage_parser
from data_prep.common.objects import described, train_command
from data_prep.common.progress import Tick, silent
from data_prep.common.stage import Stage, files_in, run_stage

# The number rises when the same inputs and settings give another result than before.
REVISION = 1
# Readers of the sets, each a module with ``Options`` and ``read``.
KINDS = {
    "ready": "READY in the layout of its authors (the paper's captured data)",
    "springgaus": "Spring-Gaus: synthetic falls, films of real falls",
    "physdreamer": "PhysDreamer: stills, Gaussians, and films from one place",
}
PACKAGES = ("av", "numpy", "opencv-python-headless", "pycolmap", "scipy")


def import_public(
    kind: str, root: Path, out: Path, options: Any = None, *, overwrite: bool = False, tick: Tick = silent
) -> dict[str, Any]:
    """Reads the object of a kind of set in ``root``, writes it to ``out`` and returns the manifest."""
    from data_prep.public.writer import ObjectWriter

    reader = import_module(f"data_prep.public.{kind}")
    options = options or reader.Options()
    found = reader.read(root, options).checked()

    def make(work: Path) -> Mapping[str, Any]:
        results = ObjectWriter(work, found, longest=options.longest, tick=tick).write(out)
        return {**results, "files": files_in(work)}

    # Folders count by the files in them.
    settings = {name: value for name, value in asdict(options).items() if not isinstance(value, Path)}
    stage = Stage("public", REVISION, found.inputs(), {"kind": kind, **settings}, PACKAGES)
    return run_stage(stage, out, make, overwrite=overwrite)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("public", __doc__, result=False)
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    readers = {kind: import_module(f"data_prep.public.{kind}") for kind in KINDS}
    for kind, reader in readers.items():
        text = (reader.__doc__ or "").replace("``", "")
        part = kinds.add_parser(
            kind, help=KINDS[kind], description=text, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        part.add_argument("root", type=Path, metavar="ROOT", help="folder in the layout of the set")
        part.add_argument("--out", type=Path, required=True, help="write the result to this folder")
        part.add_argument("--overwrite", action="store_true", help="replace a result of other inputs or settings")
        add_options(part.add_argument_group("what the set does not say, or may say otherwise"), reader.Options)

    def run(given: argparse.Namespace, tick: Tick) -> str:
        options = chosen(readers[given.kind].Options, given)
        manifest = import_public(given.kind, given.root, given.out, options, overwrite=given.overwrite, tick=tick)
        return f"{headline(given.out, manifest)}\n{summary(manifest['results'], given.out)}"

    return run_command(parser, argv, run)


def summary(results: Mapping[str, Any], out: Path) -> str:
    """A few lines about an object that was imported, for people."""
    facts = results["facts"]
    lines = [f"object      {facts['name']}", *described(facts, results["stills"], results["sequences"])]
    lines += [f"{key:<11} {facts[key]}" for key in ("gravity", "floor", "free") if key in facts]
    lines += [f"{key:<11} {value}" for key, value in results["notes"].items()]
    if results["without_alpha"]:
        return "\n".join([*lines, f"no alpha    in {', '.join(results['without_alpha'])}: segment {out} next"])
    if results["scene"]:
        return "\n".join(
            [*lines, f"scene       {results['scene']}", f"next        {train_command(facts['name'], out)}"]
        )
    return "\n".join(
        [*lines, f"next        gausim reconstruct {out}", f"then        {train_command(facts['name'], out)}"]
    )
