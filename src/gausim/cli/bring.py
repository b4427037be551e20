"""Fetching of an archive of a registry: download, verification, unpacking, and renaming at the end."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from msgspec.structs import asdict

from gausim.cli.bars import byte_bar
from gausim.core.errors import FetchError
from gausim.io.archive import only_folder, remove_tree, unpack
from gausim.io.download import continue_download
from gausim.io.files import sha256, write_json
from gausim.io.registry import Entry
from gausim.runs.directory import CONFIG, FETCHED
from gausim.runs.files import sole_writer
from gausim.runs.names import LAST_CHECKPOINT

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def default_folder(entry: Entry) -> Path:
    """Default directory of an entry."""
    return (Path("outputs", "fetched") if entry.kind == "run" else Path("data")) / entry.name


def fetch(entry: Entry, target: Path, addresses: Sequence[str]) -> bool:
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
            _take_name(folder, target)
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
            _check_content(entry, only_folder(unpacked))
        except FetchError:
            archive.unlink()
            raise
    return only_folder(unpacked)


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


def _take_name(folder: Path, target: Path) -> None:
    if hasattr(os, "sync"):
        os.sync()  # the name must not reach the disk before the files
    if os.path.lexists(target):
        raise FetchError(f"{target}: something was put there meanwhile. Move it away; then the same command goes on.")
    os.rename(folder, target)


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
