from __future__ import annotations

import io
import os
import stat
import tarfile
import zipfile
from pathlib import Path

import pytest

from gausim.core import DataError, FetchError
from gausim.io.archive import files_below, only_folder, pack, unpack

DATA = b"plain"


def tar_of(path: Path, *members: tarfile.TarInfo, mode: str = "w") -> Path:
    with tarfile.open(path, mode) as tar:
        for info in members:
            info.size = len(DATA) if info.isreg() and not info.size else info.size
            tar.addfile(info, io.BytesIO(DATA * 100) if info.isreg() else None)
    return path


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, link
    return info


def some_files(root: Path) -> dict[str, Path]:
    for name in ("b/two.txt", "a.txt", "b/c/three.npz"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(name.encode() * 7)
    return {path.relative_to(root).as_posix(): path for path in files_below(root)}


def test_the_same_files_give_the_same_bytes_and_come_back(tmp_path):
    archives = []
    for i, time in enumerate((10.0, 2e9)):
        files = some_files(tmp_path / str(i))
        for path in files.values():
            os.utime(path, (time, time))
            path.chmod(0o600 if i else 0o755)
        files = {f"top/{name}": path for name, path in (reversed(files.items()) if i else files.items())}
        total = pack(tmp_path / f"{i}.tar", files)
        archives.append((tmp_path / f"{i}.tar").read_bytes())
    assert archives[0] == archives[1] and total == sum(path.stat().st_size for path in files.values())
    counted = []
    unpack(tmp_path / "1.tar", tmp_path / "to", most_bytes=total, advance=counted.append)
    assert only_folder(tmp_path / "to") == tmp_path / "to" / "top" and sum(counted) == total
    assert all((tmp_path / "to" / name).read_bytes() == path.read_bytes() for name, path in files.items())


def test_links_and_hidden_files_are_not_packed(tmp_path):
    some_files(tmp_path / "a")
    (tmp_path / "a" / ".made").write_text("")
    assert [p.name for p in files_below(tmp_path / "a")] == ["a.txt", "three.npz", "two.txt"]
    (tmp_path / "a" / "b" / "link").symlink_to("/etc/passwd")
    with pytest.raises(DataError, match="link: expected a file or a folder, found a link"):
        files_below(tmp_path / "a")


@pytest.mark.parametrize(
    ("members", "what"),
    [
        ([member("top/a"), member("../escaped")], "leaves the folder"),
        ([member("/tmp/escaped")], "leaves the folder"),
        ([member("top\\..\\..\\escaped")], "leaves the folder"),
        ([member("C:/escaped")], "leaves the folder"),
        ([member("top/link", tarfile.SYMTYPE, "/etc")], "a link"),
        ([member("top/hard", tarfile.LNKTYPE, "/etc/passwd")], "a link"),
        ([member("top/null", tarfile.CHRTYPE)], "a device"),
        ([member("top/a"), member("top/A")], "there twice"),
        ([member("top/a/b"), member("top/a")], "there twice"),
        ([member("top/a"), member("top/a", tarfile.DIRTYPE)], "a folder where there is a file"),
        ([member("top/a\x1b[2J")], "characters that no name"),
        ([member("top/" + str(i)) for i in range(5)], "more than the 20 bytes"),
    ],
)
def test_hostile_members_are_refused_and_nothing_stays(tmp_path, members, what):
    archive = tar_of(tmp_path / "x.tar", *members)
    (tmp_path / "inner").mkdir()
    with pytest.raises(FetchError, match=what):
        unpack(archive, tmp_path / "inner" / "to", most_bytes=20)
    assert [p.name for p in tmp_path.rglob("*")] == ["x.tar", "inner"] or not list((tmp_path / "inner").iterdir())
    assert not Path("/tmp/escaped").exists() and not (tmp_path / "escaped").exists()


LINK = zipfile.ZipInfo("top/link")
LINK.external_attr = (stat.S_IFLNK | 0o777) << 16


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        (LINK, b"/etc/passwd", "'top/link' is a link"),
        ("bomb", bytes(1 << 20), "more than the 1000 bytes that were announced"),
    ],
)
def test_a_zip_may_hold_no_links_either_nor_lie_about_its_size(tmp_path, name, content, what):
    with zipfile.ZipFile(tmp_path / "x.zip", "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("top/good.txt", DATA)
        made.writestr(name, content)
    with pytest.raises(FetchError, match=what):
        unpack(tmp_path / "x.zip", tmp_path / "to", most_bytes=1000)
    assert not (tmp_path / "to").exists()


def test_zip_and_compressed_tar_are_read(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.zip", "w", zipfile.ZIP_DEFLATED) as made:
        made.mkdir("top")
        made.writestr("top/a.txt", DATA)
    tar_of(tmp_path / "x.tar.xz", member("top/a.txt"), mode="w:xz")
    for name in ("x.zip", "x.tar.xz"):
        unpack(tmp_path / name, tmp_path / name[2:], most_bytes=5)
        assert (tmp_path / name[2:] / "top" / "a.txt").read_bytes() == DATA


def test_a_tar_that_ends_with_a_zip_is_a_tar(tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as made:
        made.writestr("evil.txt", DATA)
    (tmp_path / "z.npz").write_bytes(buffer.getvalue())
    total = pack(tmp_path / "x.tar", {"top/z.npz": tmp_path / "z.npz"})
    assert zipfile.is_zipfile(tmp_path / "x.tar")
    unpack(tmp_path / "x.tar", tmp_path / "to", most_bytes=total)
    assert (tmp_path / "to" / "top" / "z.npz").read_bytes() == buffer.getvalue()


@pytest.mark.parametrize(
    "data", [b"", b"no archive at all" * 100, b"PK\x03\x04 no zip", b"\x1f\x8b\x08 no gzip", "torn"]
)
def test_what_is_no_archive_or_breaks_off_is_said_to_be_none(tmp_path, data):
    if data == "torn":
        big = member("top/a")
        big.size = 400
        data = tar_of(tmp_path / "x.tar", big).read_bytes()[:700]
    (tmp_path / "x.tar").write_bytes(data)
    with pytest.raises(FetchError, match="expected a tar or zip archive, found one that is damaged"):
        unpack(tmp_path / "x.tar", tmp_path / "to", most_bytes=1000)
    assert not (tmp_path / "to").exists()
