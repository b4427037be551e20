"""Archives: packed to the same bytes on every machine, and unpacked without trust in what they hold."""

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
from typing import IO

from gausim.core.errors import DataError, FetchError
from gausim.io.files import replacing

_ZIP_BEGINNINGS = (b"PK\x03\x04", b"PK\x05\x06")
_CHUNK = 1 << 20
# A published set of 1,000 sequences of 100 frames in 10 views has as many; more is meant to fill the disk's table.
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
    """All files of a folder in the order of their names; what begins with a dot is left out.

    Raises:
        DataError: a link or a device is among them, which an archive for others cannot carry.
    """
    found = []
    for folder, folders, names in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in [*folders, *sorted(name for name in names if not name.startswith("."))]:
            path = Path(folder) / name
            mode = path.lstat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise DataError(f"{path}: expected a file or a folder, found a link or a device. Put a copy there.")
            if stat.S_ISREG(mode):
                found.append(path)
    return sorted(found)


def pack(target: Path, files: Mapping[str, Path]) -> int:
    """Writes files, by their names in it, into a tar archive, whole or not at all; the same files give the same bytes.

    Owners, times and permissions are left out, and nothing is compressed: images and weights hardly shrink, and the
    bytes that a compressor writes depend on its version.

    Returns:
        The bytes of all files together, which :func:`unpack` asks for.
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
    """Unpacks a tar (also compressed) or zip archive into a new folder; its files and folders only, nothing else.

    Nothing in the archive decides where or how anything is written: a path that leaves the folder, a link, a device, a
    name that is there twice, and more than ``most_bytes`` in all files are refused; then the folder is removed again.
    ``advance`` is told the bytes that were written.

    Raises:
        FetchError: the archive holds one of these, or is damaged.
        OSError: the disk refuses.
    """
    folder.mkdir(parents=True)
    try:
        _unpack(archive, folder, most_bytes, advance)
    except BaseException as error:
        remove_tree(folder)
        # An OSError with a number is the disk's; without one it is gzip's or bzip2's complaint.
        if isinstance(error, _DAMAGE) or (isinstance(error, OSError) and error.errno is None):
            raise _damaged(archive, error) from error
        raise


def _unpack(archive: Path, folder: Path, most_bytes: int, advance: Callable[[int], None] | None) -> None:
    room, taken = most_bytes, dict[str, bool]()
    for member in _members(archive):
        place = _place(archive, member, taken)
        if place is None:
            continue
        room -= member.size
        if room < 0 or member.size < 0:
            raise _unsafe(archive, member.name, f"more than the {most_bytes} bytes that were announced")
        _write(archive, member, folder / place, advance)


@dataclass(frozen=True)
class _Member:
    """What an archive says it holds; ``kind`` is ``file``, ``folder`` or what else it is."""

    name: str
    size: int
    kind: str
    open: Callable[[], IO[bytes] | None]


def _members(archive: Path) -> Iterator[_Member]:
    with archive.open("rb") as file:
        # By its first bytes: a tar that ends with an .npz would pass for a zip, which is known by its end.
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
    """Where a member goes below the folder; None for folders. ``taken`` says of every path whether it is a file."""
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


def _write(archive: Path, member: _Member, path: Path, advance: Callable[[int], None] | None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    source = member.open()
    left = member.size
    with path.open("xb") as target:
        while source is not None and (chunk := source.read(_CHUNK)):
            target.write(chunk)
            left -= len(chunk)
            if advance is not None:
                advance(len(chunk))
    if source is not None:
        source.close()
    if left:
        raise EOFError(f"{member.name!r} has {member.size - left} bytes of {member.size}")


def _unsafe(archive: Path, name: str, what: str) -> FetchError:
    return FetchError(
        f"{archive.name}: {name[:120]!r} is {what}; expected plain files and folders below one folder. Nothing of the "
        "archive was kept. Do not use it, and tell whoever published it."
    )


def _damaged(archive: Path, error: BaseException) -> FetchError:
    said = (str(error) or type(error).__name__).splitlines()[0]
    return FetchError(
        f"{archive.name}: expected a tar or zip archive, found one that is damaged or another file ({said}). Nothing "
        "of it was kept. Tell whoever published it."
    )


def only_folder(folder: Path) -> Path:
    """The single folder in a folder, which archives usually begin with; the folder itself where there is more."""
    inside = list(folder.iterdir())
    return inside[0] if len(inside) == 1 and inside[0].is_dir() else folder


def remove_tree(folder: Path) -> None:
    """Removes a folder with all in it, if it is there."""
    with suppress(FileNotFoundError):
        shutil.rmtree(folder)
