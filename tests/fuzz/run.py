"""Feeds damaged files to every reader: each must be refused in words, or read as finite numbers of the right shape.

    PYTHONPATH=.:tests python tests/fuzz/run.py --count 20000

A fault is any error that is no GausSimError, an error that does not name the file, NaN or infinity in what was read,
more memory than the file could need, a crash, or a file that keeps its reader busy for a minute. Case N of a seed is
always the same file; ``--only N`` runs it again, ``--keep DIR`` writes the files that made faults.
"""

from __future__ import annotations

import argparse
import gc
import json
import multiprocessing
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from corpus import Reader, readers
from mutations import mutated

from gausim.core.errors import GausSimError

# A reader that is silent for so long hangs [s]; they take milliseconds.
PATIENCE = 60.0
# Seeds are below 100 kB, so is what their readers may need; pools of decoders and caches come on top [bytes].
MOST_MEMORY = 64 << 20
# No reader may even ask for more address space than this on top of what the process has [bytes].
MOST_ADDRESSES = 1 << 30


def main(arguments: list[str] | None = None) -> int:
    """Command line; exits with 1 if there were faults."""
    options = _parser().parse_args(arguments)
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        found = readers(Path(folder))
        _check_seeds(found)
        deck = [reader for reader in found for _ in range(reader.weight)]
        numbers = [options.only] if options.only is not None else list(range(options.count))
        began, tally = time.monotonic(), {"refused": 0, "read": 0, "faults": 0}
        for number, outcome in _outcomes(deck, numbers, options.seed, options.keep):
            tally[outcome if outcome in tally else "faults"] += 1
            if outcome not in tally:
                print(f"case {number}: {deck[number % len(deck)].name}: {outcome}", flush=True)
    print(json.dumps({"cases": len(numbers), "readers": len(found), **tally, "s": round(time.monotonic() - began, 1)}))
    return 1 if tally["faults"] else 0


def _check_seeds(found: list[Reader]) -> None:
    """Good files are read; this also loads what is loaded at first use, so that it counts for no case."""
    for reader in found:
        problem = _unfinite(reader.read(reader.file))
        if problem:
            raise SystemExit(f"{reader.name}: its good file gives {problem}")


def _outcomes(deck: list[Reader], numbers: list[int], seed: int, keep: Path | None) -> Iterator[tuple[int, str]]:
    """``refused``, ``read`` or a fault for each case, from children that are replaced when they die or hang."""
    at, context = 0, multiprocessing.get_context("fork")
    while at < len(numbers):
        inlet, outlet = context.Pipe(duplex=False)
        child = context.Process(target=_work, args=(deck, numbers[at:], seed, keep, outlet))
        child.start()
        outlet.close()
        try:
            while inlet.poll(PATIENCE):
                outcome = inlet.recv()
                yield numbers[at], outcome
                at += 1
            child.kill()
        except EOFError:  # it has ended
            pass
        child.join()
        if child.exitcode != 0:
            hangs = child.exitcode == -signal.SIGKILL
            yield numbers[at], "hangs" if hangs else f"ends the process (status {child.exitcode})"
            at += 1


def _work(deck: list[Reader], numbers: list[int], seed: int, keep: Path | None, outlet: Connection) -> None:
    """Runs cases one after the other in this process, and tells the outcome of each."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)  # decoders complain
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_ADDRESSES,) * 2)
    warnings.simplefilter("ignore")
    for number in numbers:
        reader = deck[number % len(deck)]
        rng = random.Random(f"{seed}/{number}")
        good = reader.file.read_bytes()
        bad = mutated(good, reader.kind, rng)
        reader.file.write_bytes(bad)
        try:
            outcome = _case(reader)
            if outcome.startswith("takes "):  # twice, or it was what threads of an earlier case had left behind
                outcome = _case(reader)
        finally:
            reader.file.write_bytes(good)
        if keep is not None and outcome not in ("refused", "read"):
            (keep / f"{number}_{reader.file.name}").write_bytes(bad)
        outlet.send(outcome)
    os._exit(0)


def _case(reader: Reader) -> str:
    gc.collect(0)
    before = _memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts again
    try:
        result = reader.read(reader.file)
        problem = _unfinite(result)
        outcome = f"gives {problem}" if problem else "read"
    except GausSimError as error:
        named = str(reader.file.parent) in str(error) or reader.file.name in str(error)
        outcome = "refused" if named else f"an error that names no file: {str(error)[:300]}"
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        outcome = f"{type(error).__name__} at {place.filename}:{place.lineno}: {str(error)[:200]}"
    grown = _memory("VmHWM") - before
    if outcome in ("refused", "read") and grown > MOST_MEMORY:
        return f"takes {grown >> 20} MiB"
    return outcome


def _memory(key: str) -> int:
    """Of this process [bytes]."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(key))
    return 1024 * int(line.split()[1])


def _unfinite(value: Any, where: str = "result", depth: int = 0) -> str | None:
    """What is NaN or infinite in a result, however deep; None where nothing is."""
    if isinstance(value, float | np.ndarray | torch.Tensor):
        numbers = np.asarray(value)
        bad = numbers.dtype.kind in "fc" and not np.isfinite(numbers).all()
        return f"{where} = {value if isinstance(value, float) else 'values that are no numbers'}" if bad else None
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    items = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list | tuple) else ()
    found = (_unfinite(item, f"{where}.{key}", depth + 1) for key, item in items) if depth <= 12 else ()
    return next((problem for problem in found if problem), None)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20000, help="damaged files (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="which ones (%(default)s)")
    parser.add_argument("--only", type=int, metavar="N", help="only this case")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="where files that made faults are kept")
    return parser


if __name__ == "__main__":
    sys.exit(main())
