"""`gausim fetch ADDRESS --sha256 HASH`: fetches a run or a data set that others published."""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from pathlib import Path

from gausim.cli.arguments import command_parser
from gausim.core.errors import FetchError
from gausim.io.archive import unpack
from gausim.io.files import sha256
from gausim.runs.names import CONFIG, LAST_CHECKPOINT

_WEB = ("http://", "https://")


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    arguments = _parser().parse_args(argv)
    expected = arguments.sha256.lower()
    archive = _download(arguments.address, expected)
    found = sha256(archive)
    if found != expected:
        raise FetchError(
            f"{archive}: expected SHA-256 {expected}, found {found}. Nothing was unpacked. If a second download ends "
            "the same way, do not use the file, and tell whoever published it."
        )
    with tempfile.TemporaryDirectory(dir=Path(), prefix=".fetch-") as work:
        folder = unpack(archive, Path(work, Path(arguments.address).stem))
        target = arguments.out or Path("outputs/fetched" if (folder / CONFIG).is_file() else "data") / folder.name
        _check_content(archive, folder)
        if os.path.lexists(target):
            raise FetchError(f"{target}: expected nothing there. Move it away, or name another directory with --out.")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(folder, target)
    is_run = (target / CONFIG).is_file()
    print(f"fetched: {target}")
    print(f"next: gausim {f'evaluate {target} --data DIR' if is_run else f'train data={target}'}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("fetch", " The zip archive is unpacked only if its hash is right.")
    add = parser.add_argument
    add("address", metavar="FILE|URL", help="archive that `gausim pack` made: a path, or a URL of http or https")
    add("--sha256", metavar="HASH", required=True, help="verify this hash, which the publisher states")
    add("--out", metavar="DIR", type=Path, help="write this new directory (default: outputs/fetched/NAME or data/NAME)")
    return parser


def _download(address: str, expected: str) -> Path:
    """Path of the archive; files from the web are kept in the user's cache."""
    if not address.startswith(_WEB):
        path = Path(address)
        if not path.is_file():
            raise FetchError(f"{address}: expected a file, or a URL of http or https; found neither.")
        return path
    import pooch

    options = {"known_hash": f"sha256:{expected}", "fname": f"{expected[:16]}-{Path(address).name}"}
    try:
        return Path(pooch.retrieve(address, **options, downloader=pooch.HTTPDownloader(timeout=30)))
    except (OSError, ValueError) as error:
        raise FetchError(
            f"{address}: cannot be fetched ({error}). Check the address, the hash, the connection and HTTPS_PROXY, "
            "or give the path of a copy."
        ) from error


def _check_content(archive: Path, folder: Path) -> None:
    names = (CONFIG, LAST_CHECKPOINT) if (folder / CONFIG).is_file() else ("dataset.json",)
    missing = [name for name in names if not [*folder.glob(name), *folder.glob(f"*/{name}")]]
    if missing:
        raise FetchError(
            f"{archive}: expected a run ({CONFIG}, {LAST_CHECKPOINT}) or a data set (dataset.json), found neither: "
            f"{' and '.join(missing)} missing."
        )
