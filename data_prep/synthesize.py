"""Make the embedded synthetic data set: elastic puddings and flowers, filmed by several cameras.

Bodies move by MuJoCo's finite elements (none of gausim's own models), carry Gaussians in their cells, and are
photographed by the compiled renderer. Everything follows from the settings and the seed; a set that is already there
with the same settings is left alone.
"""

from __future__ import annotations

import argparse
import importlib.util
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_prep.common.command import add_options, cores, given, headline, run_command, stage_parser
from data_prep.common.progress import Tick, each, silent
from data_prep.common.stage import Stage, run_stage
from data_prep.synthetic.plan import QUICK, Plan
from gausim.core.errors import ConfigError

if TYPE_CHECKING:
    from data_prep.synthetic.writer import SyntheticObject

# Raise when the same settings give another set than before.
REVISION = 3
PACKAGES = ("mujoco", "numpy", "scipy", "torch", "opencv-python-headless")


def synthesize(out: Path, plan: Plan, *, workers: int, overwrite: bool = False, tick: Tick = silent) -> dict[str, Any]:
    """Makes a set."""
    stage = Stage("synthesize", REVISION, {}, asdict(plan), PACKAGES)
    jobs = [(name, part) for name in plan.objects for part in (None, *range(plan.sequences))]

    def make(work: Path) -> dict[str, Any]:
        each(_write_part, [(work, plan, *job) for job in jobs], workers=workers, step="synthesizing", tick=tick)
        return {"objects": list(plan.objects)}

    return run_stage(stage, out, make, overwrite=overwrite)


def _write_part(root: Path, plan: Plan, name: str, sequence: int | None) -> None:
    """Writes the rest state (None) or one sequence of an object, unless it is there; one worker's job."""
    subject = _subject(plan, name)
    if sequence is None:
        subject.write_rest(root / name)
    else:
        subject.write_sequence(root / name, sequence)


@lru_cache(maxsize=8)
def _subject(plan: Plan, name: str) -> SyntheticObject:
    from data_prep.synthetic.writer import SyntheticObject

    return SyntheticObject(name, plan)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("synthesize", __doc__, result=False)
    add = parser.add_argument
    add("--out", type=Path, default=Path("data/synthetic"), help="write the set to this folder (%(default)s)")
    add("--overwrite", action="store_true", help="replace a set of other settings")
    add("--quick", action="store_true", help="make a tiny set, for tests")
    add("--workers", type=int, default=cores(), help="use so many processes (%(default)s)")
    add_options(parser, Plan, unset=True)
    return run_command(parser, argv, _run)


def _run(arguments: argparse.Namespace, tick: Tick) -> str:
    if importlib.util.find_spec("mujoco") is None:
        raise ConfigError("MuJoCo simulates this set. Install it with `pip install 'gausim[synth]'`.")
    plan = replace(QUICK if arguments.quick else Plan(), **given(Plan, arguments))
    manifest = synthesize(
        arguments.out, plan, workers=max(1, arguments.workers), overwrite=arguments.overwrite, tick=tick
    )
    return f"{headline(arguments.out, manifest)}: {', '.join(plan.objects)}"
