from __future__ import annotations

import random
from pathlib import Path

import pytest
from helpers.local_server import serving

from gausim.core import FetchError
from gausim.io import download
from gausim.io.download import continue_download

DATA = random.Random(0).randbytes(700_000)


@pytest.fixture
def mirror(tmp_path, monkeypatch):
    monkeypatch.setattr(download, "PAUSE", 0.0)
    (tmp_path / "mirror").mkdir()
    (tmp_path / "mirror" / "x.tar").write_bytes(DATA)
    return tmp_path / "mirror"


def bring(address: str, part: Path) -> list[int]:
    seen: list[int] = []
    continue_download(address, part, size=len(DATA), advance=seen.append)
    assert part.read_bytes() == DATA
    return seen


def test_a_file_is_brought_whole_and_told_on_the_way(mirror, tmp_path):
    with serving(mirror) as server:
        seen = bring(f"{server.url}/x.tar", tmp_path / "part")
    assert seen == sorted(seen) and seen[-1] == len(DATA) and len(server.asked) == 1
    assert bring(str(mirror / "x.tar"), tmp_path / "other")[-1] == len(DATA)


@pytest.mark.parametrize("ranges", [True, False])
def test_a_connection_that_ends_early_is_continued_or_begun_anew_without_range(mirror, tmp_path, ranges):
    with serving(mirror, ranges=ranges, cut_after=[300_000, 100_000][: 1 + ranges]) as server:
        bring(f"{server.url}/x.tar", tmp_path / "part")
    assert [asked for _, asked in server.asked] == [None, "bytes=300000-", "bytes=400000-"][: 2 + ranges]


def test_what_an_earlier_call_left_is_not_asked_for_again_and_what_is_too_long_thrown_away(mirror, tmp_path):
    part = tmp_path / "part"
    with serving(mirror) as server:
        for left in (DATA[:500_000], DATA, DATA + b"more"):
            part.write_bytes(left)
            bring(f"{server.url}/x.tar", part)
    assert [asked for _, asked in server.asked] == ["bytes=500000-", None]
    part.write_bytes(DATA[:500_000])
    assert bring(str(mirror / "x.tar"), part)[0] > 500_000


def test_servers_that_are_busy_are_asked_again_and_those_that_refuse_are_not(mirror, tmp_path):
    with serving(mirror, statuses=[503, 429]) as server:
        bring(f"{server.url}/x.tar", tmp_path / "part")
        assert len(server.asked) == 3
        with pytest.raises(FetchError, match=r"gone.tar: cannot be read \(HTTP 404, .*\). Check the address"):
            bring(f"{server.url}/gone.tar", tmp_path / "other")
        assert len(server.asked) == 4


def test_a_connection_that_never_holds_leaves_what_came(mirror, tmp_path):
    with serving(mirror, cut_after=[10_000] * 9) as server:
        with pytest.raises(FetchError, match=r"after 50000 of 700000 bytes\). The 50000 bytes that came are kept"):
            bring(f"{server.url}/x.tar", tmp_path / "part")
    assert (tmp_path / "part").read_bytes() == DATA[:50_000] and len(server.asked) == download.ATTEMPTS


def test_another_length_is_refused_before_it_is_brought(mirror, tmp_path):
    (mirror / "x.tar").write_bytes(DATA + b"x")
    with serving(mirror) as server, pytest.raises(FetchError, match="expected 700000 bytes, .* found 700001"):
        bring(f"{server.url}/x.tar", tmp_path / "part")
    assert not (tmp_path / "part").exists()
    with pytest.raises(FetchError, match="expected 700000 bytes, .* found 700001"):
        bring(str(mirror / "x.tar"), tmp_path / "part")


def test_nobody_there_names_the_mirror_as_a_way_out(mirror, tmp_path):
    with serving(mirror) as server:
        pass
    with pytest.raises(FetchError, match=r"cannot be read \(.*refused.*\). Check the connection .* --mirror DIR"):
        bring(f"{server.url}/x.tar", tmp_path / "part")
    with pytest.raises(FetchError, match=r"nowhere.tar: cannot be read \(.*No such file.*Check that the file is there"):
        bring(str(mirror / "nowhere.tar"), tmp_path / "part")
