"""Makes the paper's synthetic set with Blender: an elastic object, set off by pokes and drags, filmed all around.

Run ``python -m data_prep.blender_bunny --mesh bunny.obj``. Any OBJ or PLY mesh will do. Blender's soft body moves it
and Cycles renders it, in a Python environment that is created at the first run (about 1 GB in the user's cache
directory) and is no part of gausim's own. What was interrupted goes on picture by picture; the same settings give the
same bytes.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from data_prep.blender.environment import Blender
    from data_prep.blender.plan import Plan

REVISION = 1
SIZES = ("sequences", "frames", "views", "heldout", "stills", "samples", "points", "seed", "steps")
FACTORS = ("stiffness", "bend", "damping", "speed")


def make_set(
    mesh: Path, out: Path, plan: Plan, connect: Callable[[], Blender], *, workers: int = 1, force: bool = False
) -> dict[str, Any]:
    """Makes a set, all of it or nothing.

    Args:
        mesh: OBJ or PLY file.
        out: directory of the set, in the layout of docs/reference/files.md.
        plan: its sizes and settings.
        connect: gives Blender; called only when there is something to make.
        workers: processes of Blender at a time, of one thread each; the bytes do not depend on it.
        force: replace a set of other settings.

    Returns:
        The manifest (see :func:`data_prep.common.stage.run_stage`).

    Raises:
        DataError: the mesh is unusable, or ``out`` holds something else.
        ConfigError: the plan contradicts itself.
        BlenderError: Blender is not to be had, or gave up.
    """
    from dataclasses import asdict

    from data_prep.blender.work import make
    from data_prep.common.stage import Stage, run_stage

    settings = asdict(plan.checked())
    stage = Stage("blender_bunny", REVISION, {"mesh": mesh}, settings, packages=("numpy",))
    return run_stage(stage, out, lambda work: make(mesh, work, plan, connect(), workers=workers), force=force)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    from gausim.core import GausSimError  # after --help: this takes seconds to import

    began = time.monotonic()
    try:
        from data_prep.blender.environment import default_environment, find_blender

        plan = _plan(arguments)
        out = arguments.out or Path("data") / plan.name
        folder = arguments.blender_env or default_environment()
        manifest = make_set(
            arguments.mesh, out, plan, lambda: find_blender(arguments.blender_python, folder, say=_say),
            workers=arguments.workers, force=arguments.force,
        )  # fmt: skip
    except GausSimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted. The same command goes on where it was.", file=sys.stderr)
        return 130
    told = manifest["results"]
    print(
        f"{out}: {'made' if manifest['made'] else 'there already'}: {len(told['sequences'])} sequences, "
        f"{told['images']} pictures by Blender {told['blender']['bpy']} ({time.monotonic() - began:.0f} s)"
    )
    return 0


def _plan(arguments: argparse.Namespace) -> Plan:
    from dataclasses import replace

    from data_prep.blender.plan import Plan

    chosen: Mapping[str, Any] = {
        name: getattr(arguments, name)
        for name in (*SIZES, *FACTORS, "up", "resolution", "still_resolution", "amplitude")
    }
    given: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in chosen.items()}
    plan = Plan(name=arguments.name or arguments.mesh.stem)
    plan = plan.quick() if arguments.quick else plan
    return replace(plan, **{name: value for name, value in given.items() if value is not None}).checked()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m data_prep.blender_bunny", description=__doc__.replace("``", ""),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--mesh", type=Path, required=True, metavar="FILE", help="surface of the object, OBJ or PLY")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to (default: data/NAME)")
    parser.add_argument("--force", action="store_true", help="replace a set of other settings")
    parser.add_argument("--quick", action="store_true", help="2 sequences of 8 small frames, 4 views, 6 stills")
    parser.add_argument("--name", help="of the object (default: the mesh file's)")
    parser.add_argument("--up", choices=("x", "y", "z"), help="axis of the mesh that points up (default: y)")
    _add_sizes(parser.add_argument_group("sizes", "Defaults are the paper's."))
    motion = parser.add_argument_group("motion")
    motion.add_argument(
        "--amplitude", type=float, nargs=2, metavar=("LOW", "HIGH"),
        help="largest displacement of a sequence, drawn from this range [%% of the diagonal] (default: 8 13)",
    )  # fmt: skip
    motion.add_argument("--stiffness", type=float, help="of the soft body's springs, below 1 (default: 0.7)")
    motion.add_argument("--bend", type=float, help="resistance to bending, 0 to 10 (default: 5)")
    motion.add_argument("--damping", type=float, help="of vibrations (default: 0.02)")
    motion.add_argument("--speed", type=float, help="of time in the soft body (default: 0.11)")
    motion.add_argument("--steps", type=int, help="least steps per 1/192 s; more lose less energy (default: 30)")
    motion.add_argument("--seed", type=int, help="of everything random (default: 0)")
    _add_blender(parser.add_argument_group("Blender"))
    return parser


def _add_sizes(sizes: argparse._ArgumentGroup) -> None:
    sizes.add_argument("--sequences", type=int, help="how many motions (30)")
    sizes.add_argument("--frames", type=int, help="of each, at 24 per second (60)")
    sizes.add_argument("--views", type=int, help="cameras; the paper has 4 to 6 (5)")
    sizes.add_argument("--heldout", type=int, help="how many of them are never trained on (1)")
    sizes.add_argument("--stills", type=int, help="pictures of the rest state (200)")
    for name, what in (("--resolution", "of the sequences"), ("--still-resolution", "of the stills")):
        sizes.add_argument(name, type=int, nargs=2, metavar=("W", "H"), help=f"{what} [pixels] (540 960)")
    sizes.add_argument("--samples", type=int, help="light paths per pixel (16)")
    sizes.add_argument("--points", type=int, help="vertices whose true motion is stored (2048)")


def _add_blender(blender: argparse._ArgumentGroup) -> None:
    blender.add_argument(
        "--blender-env", type=Path, metavar="DIR",
        help="its environment, created if missing (default: gausim/blender-VERSION in the user's cache directory)",
    )  # fmt: skip
    blender.add_argument("--blender-python", type=Path, metavar="PATH", help="a Python that has bpy, instead")
    blender.add_argument("--workers", type=_positive, default=_cores(), help="processes at a time (%(default)s)")


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
