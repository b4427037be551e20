"""Zip archives from others, unpacked without trusting their content."""

from __future__ import annotations

import stat
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from gausim.core.errors import FetchError

# Bound on the unpacked size: images and weights hardly compress, so a larger ratio suggests an attack on the disk.
MOST_RATIO, ALWAYS_ALLOWED = 20, 100_000_000


def unpack(archive: Path, folder: Path) -> Path:
    """Unpacks a zip archive into ``folder``; returns its only top folder, or ``folder`` if it has several entries.

    Raises:
        FetchError: the archive is damaged, contains a link, a device, an encrypted file or a path that leaves the
            folder, or unpacks to more than 20 times its size (and more than 100 MB). Nothing is unpacked then, except
            from a damaged archive.
    """
    try:
        with zipfile.ZipFile(archive) as pack:
            members = pack.infolist()
            for member in members:
                _check(archive, member)
            total, most = sum(m.file_size for m in members), MOST_RATIO * archive.stat().st_size + ALWAYS_ALLOWED
            if total > most:
                raise FetchError(f"{archive}: expected at most {most} bytes unpacked, found {total}. Do not use it.")
            pack.extractall(folder)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError) as error:
        raise FetchError(f"{archive}: expected a zip archive, found a damaged or another file ({error}).") from error
    inside = list(folder.iterdir()) if folder.is_dir() else []
    return inside[0] if len(inside) == 1 and inside[0].is_dir() else folder


def _check(archive: Path, member: zipfile.ZipInfo) -> None:
    name, path, kind = member.filename, PurePosixPath(member.filename), stat.S_IFMT(member.external_attr >> 16)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name or not name.isprintable():
        problem = "a path that leaves the folder"
    elif kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        problem = "a link or a device"
    elif member.flag_bits & 1 or member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        problem = "encrypted, or compressed by another method than deflate"
    else:
        return
    raise FetchError(f"{archive}: {name[:120]!r} is {problem}; expected plain files and folders. Do not use it.")
