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
from functools import partial
from pathlib import Path
from typing import Any

from gausim.core.errors import DataError, FetchError
from gausim.io.files import replacing

_ZIP_BEGINNINGS = (b"PK\x03\x04", b"PK\x05\x06")
_DAMAGE = (
    tarfile.TarError,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    RuntimeError,  # an encrypted file, an unknown compression
    OverflowError,
    ValueError,
    # A file in the place of a folder, or the other way about.
    IsADirectoryError,
    NotADirectoryError,
    FileExistsError,
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
    """Unpacks a tar (also compressed) or zip archive into a new folder: plain files, without owners, rights and times.

    An archive with a path that leaves the folder, a link, a device, a duplicate name or more than ``most_bytes`` in all
    files is refused, and the folder is removed again. ``advance`` is called with the number of bytes written.

    Raises:
        FetchError: the archive is refused or damaged.
        OSError: writing to the disk failed.
    """
    folder.mkdir(parents=True)
    room = most_bytes
    try:
        for name, size, read in _files(archive):
            path = (folder / name).resolve()
            if not path.is_relative_to(folder.resolve()):
                raise ValueError(f"{name!r} leaves the folder")
            if not 0 <= size <= room:
                raise ValueError(f"more than the {most_bytes} bytes that were announced")
            room -= size
            path.parent.mkdir(parents=True, exist_ok=True)
            with read() as source, path.open("xb") as target:
                shutil.copyfileobj(source, target)
            if advance is not None:
                advance(size)
    except BaseException as error:
        remove_tree(folder)
        # An OSError with a number is from the disk, one without from gzip or bzip2.
        if isinstance(error, _DAMAGE) or (isinstance(error, OSError) and error.errno is None):
            said = (str(error) or type(error).__name__).splitlines()[0]
            raise FetchError(
                f"{archive.name}: expected a tar or zip archive of plain files, found one that is damaged or unsafe, "
                f"or another file ({said}). Nothing of it was kept. Tell whoever published it."
            ) from error
        raise


def _files(archive: Path) -> Iterator[tuple[str, int, Callable[[], Any]]]:
    """Name, size [bytes] and opener of each file."""
    with archive.open("rb") as file:
        # Decided by the first bytes: a zip is recognised by its end, which a tar that ends with an .npz shares.
        is_zip = file.read(4) in _ZIP_BEGINNINGS
    if is_zip:
        with zipfile.ZipFile(archive) as pack:
            yield from ((i.filename, i.file_size, partial(pack.open, i)) for i in pack.infolist() if not i.is_dir())
        return
    with tarfile.open(archive, "r:*") as tar:
        for info in tar:
            if info.isreg():
                yield info.name, info.size, partial(tar.extractfile, info)
            elif not info.isdir():
                raise ValueError(f"{info.name!r} is a link or a device")


def only_folder(folder: Path) -> Path:
    """The only subfolder of a folder, as most archives have one; the folder itself if it contains more."""
    inside = list(folder.iterdir())
    return inside[0] if len(inside) == 1 and inside[0].is_dir() else folder


def remove_tree(folder: Path) -> None:
    """Removes a folder with its content, if it exists."""
    with suppress(FileNotFoundError):
        shutil.rmtree(folder)
