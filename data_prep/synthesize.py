"""Makes the embedded synthetic data set: elastic puddings and flowers, filmed by several cameras.

Run ``gausim prepare synthesize``. Bodies move by MuJoCo's finite elements (none of gausim's own models), carry
Gaussians in their cells, and are photographed by the reference renderer. Everything follows from the settings and the
seed; a set that is already there with the same settings is left alone.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import multiprocessing
import os
import shutil
import sys
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path

from gausim.core import DataError, GausSimError

MANIFEST = "synthetic.json"
# Raise when the same settings give another set than before.
GENERATOR = 2
REPLACED = ".replaced"


def synthesize(out: Path, settings: dict[str, object], *, workers: int, force: bool = False) -> bool:
    """Writes the set of ``settings`` (fields of ``Plan``) to ``out``, all of it or nothing.

    Returns:
        False where ``out`` holds that very set already.

    Raises:
        DataError: ``out`` holds something else.
    """
    manifest = {"generator": GENERATOR, "settings": settings}
    if _is_there(out, manifest, force=force):
        return False
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        _write_all(temporary, settings, workers=workers)
        (temporary / MANIFEST).write_text(json.dumps(manifest, indent=1))
        if out.is_dir():
            os.replace(out, temporary / REPLACED)
        os.replace(temporary, out)
        shutil.rmtree(out / REPLACED, ignore_errors=True)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return True


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    if importlib.util.find_spec("mujoco") is None:
        print("error: MuJoCo simulates this set. Install it with `pip install 'gausim[synth]'`.", file=sys.stderr)
        return 2
    from data_prep.synthetic.writer import QUICK, Plan  # after --help: these take seconds to import

    chosen = {
        name: getattr(arguments, name) for name in ("resolution", "sequences", "frames", "kernels", "objects", "swing")
    }
    given = {name: value for name, value in chosen.items() if value is not None}
    if "swing" in given:
        given["swing"] = tuple(given["swing"])
    try:
        plan = replace(QUICK if arguments.quick else Plan(), seed=arguments.seed, **given)
        settings = json.loads(json.dumps(asdict(plan)))
        made = synthesize(arguments.out, settings, workers=arguments.workers, force=arguments.force)
    except GausSimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{arguments.out}: {'made' if made else 'there already'}: {', '.join(plan.objects)}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="gausim prepare synthesize", description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("data/synthetic"), help="folder of the set (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="a tiny set, for tests")
    parser.add_argument("--force", action="store_true", help="replace a set of other settings")
    parser.add_argument("--workers", type=_positive, default=_cores(), help="processes (%(default)s)")
    parser.add_argument("--objects", type=_names, metavar="NAME,NAME", help="only these objects")
    parser.add_argument("--sequences", type=_positive, help="sequences per object")
    parser.add_argument("--frames", type=_positive, help="frames per sequence, at least 16")
    parser.add_argument("--resolution", type=_positive, help="of the videos [pixels]")
    parser.add_argument("--kernels", type=_positive, help="Gaussians per object")
    parser.add_argument(
        "--swing",
        type=float,
        nargs=2,
        metavar=("LOW", "HIGH"),
        help="amplitude of all pushes [fractions of the object's diagonal]; each object's own unless given",
    )
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _is_there(out: Path, manifest: dict[str, object], *, force: bool) -> bool:
    """Whether ``out`` holds the set already; raises where writing it would destroy something else."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return False
    path = out / MANIFEST
    if not path.is_file():
        raise DataError(f"{out}: exists and is no synthetic set ({MANIFEST} is missing). Choose another --out.")
    if json.loads(path.read_text()) == manifest:
        return True
    if not force:
        raise DataError(f"{path}: a set of other settings is there. Choose another --out, or replace it with --force.")
    return False


def _write_all(root: Path, settings: dict[str, object], *, workers: int) -> None:
    from data_prep.common.progress import bars

    objects, sequences = settings["objects"], settings["sequences"]
    assert isinstance(objects, list) and isinstance(sequences, int)
    jobs = [(name, part) for name in objects for part in (None, *range(sequences))]
    with bars("synthesizing") as tick:
        if workers == 1:
            for number, job in enumerate(jobs, 1):
                _write_part(root, settings, *job)
                tick("synthesizing", number, len(jobs))
            return
        # Not forked: a fork of a process with live threads (torch, rich) can hang.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context, initializer=_one_thread) as pool:
            submit: Callable[..., Future[None]] = pool.submit
            pending = [submit(_write_part, root, settings, *job) for job in jobs]
            for number, done in enumerate(as_completed(pending), 1):
                if done.exception() is not None:
                    pool.shutdown(cancel_futures=True)
                done.result()
                tick("synthesizing", number, len(jobs))


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


def _write_part(root: Path, settings: dict[str, object], name: str, sequence: int | None) -> None:
    """Writes the rest state (None) or one sequence of an object; one worker's job."""
    subject = _subject(json.dumps(settings), name)
    if sequence is None:
        subject.write_rest(root / name)
    else:
        subject.write_sequence(root / name, sequence)


@lru_cache(maxsize=8)
def _subject(settings: str, name: str):  # type: ignore[no-untyped-def]  # its class is imported late
    from data_prep.synthetic.writer import Plan, SyntheticObject

    fields = json.loads(settings)
    listed = {key: tuple(fields[key]) for key in ("objects", "swing") if fields[key] is not None}
    return SyntheticObject(name, Plan(**{**fields, **listed}))


if __name__ == "__main__":
    sys.exit(main())
