"""`gausim fetch NAME`: fetches published runs and data sets, verified before unpacking, or packs one."""

from __future__ import annotations

import argparse
import errno
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from msgspec.structs import asdict

from gausim.cli.arguments import command_parser
from gausim.cli.output import byte_bar
from gausim.compose.data_paths import FETCHED
from gausim.core.errors import FetchError
from gausim.io.archive import only_folder, remove_tree, unpack
from gausim.io.download import continue_download
from gausim.io.files import sha256, write_json
from gausim.io.registry import SHIPPED, Entry, Registry, mirrored, read_registry
from gausim.runs.files import sole_writer
from gausim.runs.names import CONFIG, LAST_CHECKPOINT

EPILOG = """\
A registry is a TOML file that names archives with address, size, SHA-256, licence and card (docs/reference/files.md).
Nothing is unpacked before size and SHA-256 are right, and nothing in an archive is executed. An interrupted download
goes on when the same command is given again.

  gausim fetch --list --registry https://example.org/gausim/registry.toml
  gausim fetch bunny --registry registry.toml
  gausim fetch bunny --registry registry.toml --mirror /mnt/mirror      # without a network
  gausim fetch --pack outputs/bunny/seed_0 --name bunny --licence CC-BY-4.0 --out published"""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def main(argv: list[str]) -> int:
    """Runs the command; returns the exit status."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    wanted = [bool(arguments.names), arguments.list, arguments.pack is not None]
    if sum(wanted) != 1:
        parser.error("expected either NAME, --list or --pack RUN|DIR")
    if arguments.out is not None and len(arguments.names) > 1:
        parser.error("--out is the directory of one NAME")
    if arguments.pack is not None:
        if arguments.name is None:
            parser.error("--pack: expected --name NAME, by which the entry is asked for")
        from gausim.cli.pack import pack_published

        out = arguments.out or Path("published")
        facts = {"title": arguments.title, "licence": arguments.licence, "data": arguments.data}
        print(pack_published(arguments.pack, out, name=arguments.name, **facts))
        return 0
    registry = read_registry(arguments.registry or SHIPPED)
    if arguments.list:
        _print_list(registry)
        return 0
    entries = [registry.find(name) for name in arguments.names]  # check all names before the first download
    for entry in entries:
        _fetch(entry, arguments, registry)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("fetch", epilog=EPILOG)
    add = parser.add_argument
    add("names", metavar="NAME", nargs="*", help="entries of the registry")
    add("--list", action="store_true", help="print what the registry lists")
    add("--registry", metavar="FILE|URL", help="default: the one that came with gausim")
    add("--mirror", metavar="DIR|URL", help="take the archives from here instead of their addresses")
    add(
        "--out", metavar="DIR", type=Path,
        help="directory that is made; default outputs/fetched/NAME for a run, data/NAME for a data set, published "
        "with --pack",
    )  # fmt: skip
    packing = parser.add_argument_group("publishing")
    add = packing.add_argument
    add("--pack", metavar="RUN|DIR", type=Path, help="write NAME.tar of a finished run or a data set, and its entry")
    add("--name", metavar="NAME", help="of the entry")
    add("--licence", metavar="ID", help="under which others may use it, e.g. CC-BY-4.0; default that of dataset.json")
    add("--title", metavar="TEXT", help="description in one line")
    add("--data", metavar="NAME", default="", help="of a run: the entry of its data set")
    return parser


def _print_list(registry: Registry) -> None:
    from rich.console import Console
    from rich.table import Table

    if not registry.entries:
        print(f"{registry.source}: lists nothing yet. Give another registry with --registry FILE|URL.")
        return
    shown = Table(title=registry.source, title_justify="left")
    for head in ("name", "kind", "size", "licence", "what", "card"):
        shown.add_column(head, justify="right" if head == "size" else "left", overflow="fold")
    for entry in registry.entries.values():
        shown.add_row(entry.name, entry.kind, _megabytes(entry.size), entry.licence, entry.title, entry.card)
    Console().print(shown)


def _fetch(entry: Entry, arguments: argparse.Namespace, registry: Registry) -> None:
    target = arguments.out or _default_folder(entry)
    addresses = [mirrored(entry, arguments.mirror)] if arguments.mirror else list(entry.addresses)
    card = f", card {entry.card}" if entry.card else ""
    print(f"{entry.name}: {entry.title} ({entry.kind}, {_megabytes(entry.size)}, licence {entry.licence}{card})")
    made = _bring(entry, target, addresses)
    print(f"{'fetched' if made else 'was fetched before'}: {target}")
    if entry.kind == "data":
        print(f"next: gausim train data=object data.root={target}")
        return
    data, known = "DIR", registry.entries.get(entry.data)
    if known is not None:
        print(f"its data: gausim fetch {entry.data}")
        data = str(_default_folder(known))
    print(f"next: gausim evaluate {target} --data {data}")


def _megabytes(count: int) -> str:
    """A number of bytes in MB, as text."""
    return f"{count / 1e6:,.1f} MB" if count < 1e9 else f"{count / 1e9:,.2f} GB"


def _default_folder(entry: Entry) -> Path:
    return (Path("outputs", "fetched") if entry.kind == "run" else Path("data")) / entry.name


def _bring(entry: Entry, target: Path, addresses: Sequence[str]) -> bool:
    """Makes the directory ``target`` of an entry atomically; returns False if it was fetched before.

    Addresses are tried in their order. Downloads are kept in a hidden folder beside the target, from which the same
    call continues after an interruption.

    Raises:
        FetchError: the target has other content, no address has the file, its size or hash is wrong, the archive is
            unsafe, or the disk is full.
        BusyError: another process is fetching the entry.
    """
    if _is_there(entry, target):
        return False
    if not addresses:
        raise FetchError(
            f"entry.{entry.name}: has no address. Give a copy of {entry.file} with --mirror DIR|URL, or fill "
            "'addresses' in the registry."
        )
    work = target.with_name(f".{target.name}.fetching")
    archive, unpacked = work / f"{entry.sha256[:16]}.part", work / "unpacked"
    with _disk_errors(target, work), sole_writer(work / ".lock", doing=f"fetching {target}"):
        try:
            _check_room(entry, archive, target)
            _download(entry, archive, addresses)
            folder = _unpack(entry, archive, unpacked)
            note = {key: value for key, value in asdict(entry).items() if key not in ("addresses", "unpacked")}
            write_json(folder / FETCHED, note)
            if hasattr(os, "sync"):
                os.sync()  # the name must not reach the disk before the files
            if os.path.lexists(target):
                raise FetchError(
                    f"{target}: something was put there meanwhile. Move it away; then the same command goes on."
                )
            os.rename(folder, target)
            archive.unlink()
        finally:
            remove_tree(unpacked)
            if not archive.exists():
                remove_tree(work)
    return True


def _is_there(entry: Entry, target: Path) -> bool:
    if not os.path.lexists(target):
        return False
    try:
        known: Any = json.loads((target / FETCHED).read_text())["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        known = None
    if known == entry.sha256:
        return True
    raise FetchError(
        f"{target}: expected nothing there, found {'another version' if known else 'something else'}. Move it away, or "
        "name another directory with --out DIR."
    )


def _check_room(entry: Entry, archive: Path, target: Path) -> None:
    have = archive.stat().st_size if archive.exists() else 0
    needed, free = entry.size - have + entry.unpacked, shutil.disk_usage(archive.parent).free
    if needed > free:
        raise FetchError(
            f"{target.parent}: expected {needed} bytes of free space for {entry.name}, found {free}. Make room, or "
            "name a directory of another disk with --out DIR."
        )


def _download(entry: Entry, archive: Path, addresses: Sequence[str]) -> None:
    """Tries the addresses until one has a file of the entry's size and hash."""
    refused: list[str] = []
    for address in addresses:
        try:
            with byte_bar(entry.size, f"fetch {entry.name}") as bar:
                continue_download(address, archive, size=entry.size, advance=bar)
        except FetchError as error:
            refused.append(str(error))
            continue
        found = sha256(archive)
        if found == entry.sha256:
            return
        archive.unlink()
        refused.append(
            f"{address}: expected SHA-256 {entry.sha256}, found {found}. The file was removed, nothing was unpacked. "
            "Give the same command again; if it ends the same way, the file was changed after the registry was "
            "written: do not use it, and tell whoever keeps the registry."
        )
    raise FetchError(" ".join(refused))


def _unpack(entry: Entry, archive: Path, unpacked: Path) -> Path:
    """The folder with the unpacked content; an invalid archive is removed."""
    remove_tree(unpacked)
    with byte_bar(entry.unpacked, f"unpack {entry.name}", pieces=True) as bar:
        try:
            unpack(archive, unpacked, most_bytes=entry.unpacked, advance=bar)
            folder = only_folder(unpacked)
            _check_content(entry, folder)
        except FetchError:
            archive.unlink()
            raise
    return folder


def _check_content(entry: Entry, folder: Path) -> None:
    if entry.kind == "run":
        missing = [name for name in (CONFIG, LAST_CHECKPOINT) if not (folder / name).is_file()]
    else:
        found = (folder / "dataset.json").is_file() or next(folder.glob("*/dataset.json"), None) is not None
        missing = [] if found else ["dataset.json, in it or in a folder of it"]
    if missing:
        raise FetchError(
            f"{entry.file}: expected a {entry.kind}, found none: {' and '.join(missing)} missing. Nothing of it was "
            "kept. Tell whoever keeps the registry."
        )


@contextmanager
def _disk_errors(target: Path, work: Path) -> Iterator[None]:
    """Converts errors of the disk to readable ones; if the disk is full, our files are removed."""
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            remove_tree(work)
            raise FetchError(
                f"{target}: the disk is full ({error.strerror}). What was written was removed again. Make room, or "
                "name a directory of another disk with --out DIR."
            ) from error
        raise FetchError(
            f"{error.filename or target}: cannot be written or read ({error.strerror or error}). Correct the "
            "permissions, or name another directory with --out DIR."
        ) from error
