"""Archives: packed reproducibly to the byte, and unpacked without trusting their content."""

from __future__ import annotations

import lzma
import os
import shutil
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from gausim.core.errors import DataError, FetchError
from gausim.io.files import replacing

_ZIP_BEGINNINGS = (b"PK\x03\x04", b"PK\x05\x06")
_CHUNK = 1 << 20
# As many as a set of 1,000 sequences of 100 frames in 10 views; more suggests an attack on the file system.
MOST_MEMBERS = 1_000_000
_DAMAGE = (
    tarfile.TarError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    NotImplementedError,
    OverflowError,
    ValueError,
)


def files_below(root: Path) -> list[Path]:
    """All files of a folder in the order of their names, without names that begin with a dot.

    Raises:
        DataError: the folder contains a link or a device, which archives do not support.
    """
    found = []
    for path in sorted(root.rglob("*")):
        if any(part.startswith(".") for part in path.relative_to(root).parts):
            continue
        mode = path.lstat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise DataError(f"{path}: expected a file or a folder, found a link or a device. Put a copy there.")
        if stat.S_ISREG(mode):
            found.append(path)
    return found


def pack(target: Path, files: Mapping[str, Path]) -> int:
    """Writes files under the given names into a tar archive, atomically and reproducibly; returns their size [bytes].

    Owners, times and permissions are omitted. The archive is not compressed: images and weights hardly shrink, and
    the output of a compressor depends on its version.
    """
    total = 0
    with replacing(target) as temporary, tarfile.open(temporary, "w", format=tarfile.PAX_FORMAT) as tar:
        for name in sorted(files):
            info = tarfile.TarInfo(name)
            info.mode = 0o644
            with files[name].open("rb") as file:
                info.size = os.fstat(file.fileno()).st_size
                tar.addfile(info, file)
            total += info.size
    return total


def unpack(archive: Path, folder: Path, *, most_bytes: int, advance: Callable[[int], None] | None = None) -> None:
    """Unpacks a tar (also compressed) or zip archive into a new folder, regular files and folders only.

    An archive with a path that leaves the folder, a link, a device, a duplicate name or more than ``most_bytes`` in all
    files is refused, and the folder is removed again. ``advance`` is called with the number of bytes written.

    Raises:
        FetchError: the archive is refused or damaged.
        OSError: writing to the disk failed.
    """
    folder.mkdir(parents=True)
    room, taken = most_bytes, dict[str, bool]()
    try:
        for member in _members(archive):
            place = _place(archive, member, taken)
            if place is None:
                continue
            room -= member.size
            if room < 0 or member.size < 0:
                raise _unsafe(archive, member.name, f"more than the {most_bytes} bytes that were announced")
            _write(member, folder / place, advance)
    except BaseException as error:
        remove_tree(folder)
        # An OSError with a number is from the disk, one without from gzip or bzip2.
        if isinstance(error, _DAMAGE) or (isinstance(error, OSError) and error.errno is None):
            said = (str(error) or type(error).__name__).splitlines()[0]
            raise FetchError(
                f"{archive.name}: expected a tar or zip archive, found one that is damaged or another file ({said}). "
                "Nothing of it was kept. Tell whoever published it."
            ) from error
        raise


@dataclass(frozen=True)
class _Member:
    """A member that an archive declares; ``kind`` is ``file``, ``folder`` or the name of another kind."""

    name: str
    size: int
    kind: str
    open: Callable[[], Any]  # the stream of a file


def _members(archive: Path) -> Iterator[_Member]:
    with archive.open("rb") as file:
        # Decided by the first bytes: a zip is recognised by its end, which a tar that ends with an .npz shares.
        is_zip = file.read(4) in _ZIP_BEGINNINGS
    return _of_zip(archive) if is_zip else _of_tar(archive)


def _of_tar(archive: Path) -> Iterator[_Member]:
    with tarfile.open(archive, "r:*") as tar:
        for info in tar:
            kind = "file" if info.type in (tarfile.REGTYPE, tarfile.AREGTYPE) else "folder" if info.isdir() else ""
            kind = kind or ("a link" if info.issym() or info.islnk() else "a device or an entry of another kind")
            yield _Member(info.name, info.size, kind, partial(tar.extractfile, info))


def _of_zip(archive: Path) -> Iterator[_Member]:
    with zipfile.ZipFile(archive) as pack:
        for info in pack.infolist():
            mode = stat.S_IFMT(info.external_attr >> 16)
            kind = "folder" if info.is_dir() else "file"
            if mode not in (0, stat.S_IFREG, stat.S_IFDIR):
                kind = "a link" if mode == stat.S_IFLNK else "a device or an entry of another kind"
            elif info.flag_bits & 1:
                kind = "an encrypted file"
            yield _Member(info.filename, info.file_size, kind, partial(pack.open, info))


def _place(archive: Path, member: _Member, taken: dict[str, bool]) -> PurePosixPath | None:
    """Path of a member below the folder; None for folders. ``taken`` maps used paths to whether they are files."""
    name, path = member.name, PurePosixPath(member.name)
    if member.kind not in ("file", "folder"):
        raise _unsafe(archive, name, member.kind)
    if path.is_absolute() or ".." in path.parts or "\\" in name or PureWindowsPath(name).drive:
        raise _unsafe(archive, name, "a path that leaves the folder")
    if not name.isprintable():
        raise _unsafe(archive, name, "a name with characters that no name should have")
    folders = [str(part).casefold() for part in path.parents if part.parts]
    own = str(path).casefold()
    if member.kind == "folder":
        if taken.get(own):
            raise _unsafe(archive, name, "a folder where there is a file")
        return None
    if not path.parts or own in taken or any(taken.get(part) for part in folders):
        raise _unsafe(archive, name, "a name that is there twice")
    taken.update(dict.fromkeys(folders, False))
    taken[own] = True
    if len(taken) > MOST_MEMBERS:
        raise _unsafe(archive, name, f"more than {MOST_MEMBERS} files")
    return path


def _write(member: _Member, path: Path, advance: Callable[[int], None] | None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    left = member.size
    with member.open() as source, path.open("xb") as target:
        while chunk := source.read(_CHUNK):
            target.write(chunk)
            left -= len(chunk)
            if advance is not None:
                advance(len(chunk))
    if left:
        raise EOFError(f"{member.name!r} has {member.size - left} bytes of {member.size}")


def _unsafe(archive: Path, name: str, what: str) -> FetchError:
    return FetchError(
        f"{archive.name}: {name[:120]!r} is {what}; expected plain files and folders below one folder. Nothing of the "
        "archive was kept. Do not use it, and tell whoever published it."
    )


def only_folder(folder: Path) -> Path:
    """The only subfolder of a folder, as most archives have one; the folder itself if it contains more."""
    inside = list(folder.iterdir())
    return inside[0] if len(inside) == 1 and inside[0].is_dir() else folder


def remove_tree(folder: Path) -> None:
    """Removes a folder with its content, if it exists."""
    with suppress(FileNotFoundError):
        shutil.rmtree(folder)
