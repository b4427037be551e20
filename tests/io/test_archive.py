import stat
import zipfile
from pathlib import Path

import pytest

from gausim.core import FetchError
from gausim.io.archive import unpack

LINK, DEVICE = zipfile.ZipInfo("top/link"), zipfile.ZipInfo("top/null")
LINK.external_attr, DEVICE.external_attr = (stat.S_IFLNK | 0o777) << 16, (stat.S_IFCHR | 0o666) << 16


def zipped(
    path: Path, member: str | zipfile.ZipInfo, content: bytes = b"x", method: int = zipfile.ZIP_DEFLATED
) -> Path:
    with zipfile.ZipFile(path, "w", method) as made:
        made.writestr("top/good.txt", b"plain")
        made.writestr(member, content)
    return path


def test_the_only_folder_of_an_archive_is_returned(tmp_path: Path) -> None:
    assert unpack(zipped(tmp_path / "a.zip", "top/b/c.txt"), tmp_path / "a") == tmp_path / "a" / "top"
    assert (tmp_path / "a/top/b/c.txt").read_bytes() == b"x"
    assert unpack(zipped(tmp_path / "b.zip", "other.txt"), tmp_path / "b") == tmp_path / "b"


@pytest.mark.parametrize(
    ("member", "what"),
    [
        ("../escaped", "leaves the folder"), ("/tmp/escaped", "leaves the folder"),
        ("top\\..\\escaped", "leaves the folder"), ("C:/escaped", "leaves the folder"),
        ("top/a\x1b[2J", "leaves the folder"), (LINK, "a link or a device"), (DEVICE, "a link or a device"),
    ],
)  # fmt: skip
def test_hostile_members_are_refused_before_anything_is_written(tmp_path: Path, member, what: str) -> None:
    with pytest.raises(FetchError, match=what):
        unpack(zipped(tmp_path / "x.zip", member), tmp_path / "to")
    assert [path.name for path in tmp_path.iterdir()] == ["x.zip"]


def test_an_archive_that_unpacks_to_far_more_is_refused(tmp_path: Path) -> None:
    bomb = zipped(tmp_path / "x.zip", "bomb", bytes(110_000_000))
    with pytest.raises(FetchError, match="bytes unpacked, found 110000005"):
        unpack(bomb, tmp_path / "to")
    assert not (tmp_path / "to").exists()


@pytest.mark.parametrize("data", [b"", b"no archive at all" * 100, b"PK\x03\x04 no zip", None])
def test_damaged_files_and_other_methods_are_refused(tmp_path: Path, data: bytes | None) -> None:
    path = zipped(tmp_path / "x.zip", "top/a", b"abc" * 100, zipfile.ZIP_LZMA)
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(FetchError, match="x.zip.*(damaged|another method)"):
        unpack(path, tmp_path / "to")


def test_a_flipped_bit_is_seen(tmp_path: Path) -> None:
    path = zipped(tmp_path / "x.zip", "top/a", bytes(range(256)), zipfile.ZIP_STORED)
    path.write_bytes(path.read_bytes().replace(bytes(range(256)), bytes(256)))
    with pytest.raises(FetchError, match="damaged"):
        unpack(path, tmp_path / "to")
