"""Make the paper's synthetic set with Blender: an elastic object, set off by pokes and drags, filmed all around.

Any OBJ or PLY mesh will do. Blender's soft body moves it and Cycles renders it, in a Python environment of their own
(where it is missing, the command says how to make it). What was interrupted goes on picture by picture; the same
settings give the same bytes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from data_prep.blender.environment import BlenderProcess, default_python, find_blender
from data_prep.blender.plan import Pictures, Plan, Soft
from data_prep.common.command import add_options, cores, given, headline, run_command, stage_parser
from data_prep.common.progress import Tick, silent
from data_prep.common.stage import Stage, run_stage

REVISION = 1


def make_set(
    mesh: Path, out: Path, plan: Plan, connect: Callable[[], BlenderProcess], *, workers: int = 1,
    overwrite: bool = False, tick: Tick = silent,
) -> dict[str, Any]:  # fmt: skip
    """Makes a set, all of it or nothing.

    Raises:
        DataError: the mesh is unusable, or ``out`` holds something else.
        BlenderError: Blender is not to be had, or gave up.
    """

    def make(work: Path) -> dict[str, Any]:
        from data_prep.blender.work import make_images

        return make_images(mesh, work, plan, connect(), workers=workers, tick=tick)

    stage = Stage("blender_bunny", REVISION, {"mesh": mesh}, plan.settings(), ("numpy",))
    return run_stage(stage, out, make, overwrite=overwrite)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("blender_bunny", __doc__, result=False)
    add = parser.add_argument
    add("--mesh", type=Path, required=True, metavar="FILE", help="take this surface of the object, OBJ or PLY")
    add("--out", type=Path, metavar="DIR", help="write to this folder (default: data/NAME)")
    add("--overwrite", action="store_true", help="replace a set of other settings")
    add("--quick", action="store_true", help="make 2 sequences of 8 small frames, 4 views, 6 stills")
    group = parser.add_argument_group("sizes and motion", "Defaults are the paper's.")
    for kind in (Plan, Pictures, Soft):
        add_options(group, kind, unset=True)
    add = parser.add_argument_group("Blender").add_argument
    add(
        "--blender-python", type=Path, default=default_python(), metavar="PATH",
        help="use this Python, which has bpy (%(default)s)",
    )  # fmt: skip
    add("--workers", type=int, default=cores(), help="use so many processes at a time (%(default)s)")
    return run_command(parser, argv, _run)


def _run(arguments: argparse.Namespace, tick: Tick) -> str:
    began = time.monotonic()
    plan = Plan(name=arguments.mesh.stem)
    plan = plan.quick() if arguments.quick else plan
    pictures, soft = replace(plan.pictures, **given(Pictures, arguments)), replace(plan.soft, **given(Soft, arguments))
    plan = replace(plan, **given(Plan, arguments), pictures=pictures, soft=soft)
    out = arguments.out or Path("data") / plan.name
    manifest = make_set(
        arguments.mesh, out, plan, lambda: find_blender(arguments.blender_python),
        workers=max(1, arguments.workers), overwrite=arguments.overwrite, tick=tick,
    )  # fmt: skip
    told = manifest["results"]
    return (
        f"{headline(out, manifest)}: {len(told['sequences'])} sequences, {told['images']} pictures by Blender "
        f"{told['blender']['bpy']} ({time.monotonic() - began:.0f} s)"
    )
