"""Make a corpus of random elastic bodies with known motion and material, to learn elasticity from.

Shapes (blobs, stems, slabs, shells, forks, lattices, rings and figures), materials, pins, pushes and frame rates are
random; MuJoCo's finite elements move the bodies. There are no pictures. Every body follows from the seed and its
number alone; what was interrupted goes on body by body.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
from safetensors.numpy import load_file, save

from data_prep.common.command import add_options, chosen, cores, headline, run_command, stage_parser
from data_prep.common.progress import Tick, each, silent
from data_prep.common.stage import Stage, run_stage
from data_prep.random_bodies.plan import Plan
from gausim.core.errors import ConfigError
from gausim.io.files import write_durably, write_json

# Raise when the same settings give another corpus than before.
REVISION = 1
PACKAGES = ("mujoco", "numpy", "scipy")
SHARD, PIECES = 32, "pieces"  # bodies of a shard; folder of those that are in none yet


def make_corpus(out: Path, plan: Plan, *, workers: int, overwrite: bool = False, tick: Tick = silent) -> dict[str, Any]:
    """Makes a corpus."""
    settings = asdict(plan)
    stage = Stage("corpus", REVISION, {}, settings, PACKAGES)
    return run_stage(stage, out, lambda work: _make(work, plan, settings, workers, tick), overwrite=overwrite)


def _make(work: Path, plan: Plan, settings: dict[str, Any], workers: int, tick: Tick) -> dict[str, Any]:
    """Every body is a file of its own, its facts last, until all are there; then they are gathered in shards."""
    from gausim.data.corpus import MANIFEST, SCHEMA

    jobs = [(work, plan, number) for number in range(plan.bodies)]
    each(_write_body, jobs, workers=workers, step="bodies", tick=tick)
    records = []
    for first in range(0, plan.bodies, SHARD):
        shard = f"shard_{first // SHARD:05d}.safetensors"
        pieces = [_piece(work, number) for number in range(first, min(first + SHARD, plan.bodies))]
        records += [{**json.loads(piece.with_suffix(".json").read_bytes()), "shard": shard} for piece in pieces]
        if not (work / shard).is_file():
            tensors = {key: tensor for piece in pieces for key, tensor in load_file(piece).items()}
            write_durably(work / shard, save(tensors))
    redrawn = sum(record["redrawn"] for record in records)
    manifest = {"schema": SCHEMA, "seed": plan.seed, "settings": settings, "redrawn": redrawn, "bodies": records}
    write_json(work / MANIFEST, manifest)
    shutil.rmtree(work / PIECES)
    return {"bodies": len(records), "sequences": plan.sequences * len(records), "redrawn": redrawn}


def _piece(work: Path, number: int) -> Path:
    return work / PIECES / f"{number:06d}.safetensors"


def _write_body(work: Path, plan: Plan, number: int) -> None:
    """Writes a body unless it is there; one worker's job."""
    piece = _piece(work, number)
    if piece.with_suffix(".json").is_file():
        return
    from data_prep.random_bodies.maker import make_body

    tensors, record = make_body(plan, number)
    write_durably(piece, save({f"{record.name}.{field}": tensor for field, tensor in tensors.items()}))
    write_json(piece.with_suffix(".json"), msgspec.to_builtins(record))


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("corpus", __doc__)
    parser.add_argument("--workers", type=int, default=cores(), help="use so many processes (%(default)s)")
    add_options(parser, Plan)
    return run_command(parser, argv, _run)


def _run(arguments: argparse.Namespace, tick: Tick) -> str:
    plan = chosen(Plan, arguments)
    if importlib.util.find_spec("mujoco") is None:
        raise ConfigError("MuJoCo moves these bodies. Install it with `pip install 'gausim[synth]'`.")
    manifest = make_corpus(
        arguments.out, plan, workers=max(1, arguments.workers), overwrite=arguments.overwrite, tick=tick
    )
    told = manifest["results"]
    return (
        f"{headline(arguments.out, manifest)}: {told['bodies']} bodies, {told['sequences']} sequences; "
        f"{told['redrawn']} bodies and pushes drawn again"
    )
