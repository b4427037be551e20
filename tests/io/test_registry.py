from __future__ import annotations

from pathlib import Path

import pytest
from helpers.local_server import serving
from msgspec.structs import replace

from gausim.core import FetchError
from gausim.io.registry import SCHEMA, Entry, entry_text, mirrored, read_registry

ENTRY = Entry(
    name="flower", kind="run", title='A "flower", ä \\ 😀', file="flower.tar", sha256="0" * 63 + "f", size=10,
    unpacked=8, licence="CC-BY-4.0", addresses=("flower.tar", "https://example.org/flower.tar"), card="flower.md",
    data="flower-data",
)  # fmt: skip


def write(path: Path, *entries: Entry) -> Path:
    path.write_text(f'schema = "{SCHEMA}"\n' + "\n".join(entry_text(entry) for entry in entries))
    return path


def test_what_ships_is_a_registry_and_names_no_address():
    assert read_registry().entries == {}


def test_an_entry_is_read_as_it_was_written_with_addresses_from_where_the_registry_lies(tmp_path):
    read = read_registry(write(tmp_path / "r.toml", ENTRY)).find("flower")
    there = (str(tmp_path / "flower.tar"), "https://example.org/flower.tar")
    assert read == replace(ENTRY, addresses=there, card=str(tmp_path / "flower.md"))


def test_a_registry_of_the_web_names_addresses_of_the_web_only(tmp_path):
    evil = replace(ENTRY, addresses=("/etc/passwd", "sub/flower.tar"))
    write(tmp_path / "r.toml", evil)
    with serving(tmp_path) as server:
        read = read_registry(f"{server.url}/r.toml").find("flower")
        assert read.addresses == (f"{server.url}/etc/passwd", f"{server.url}/sub/flower.tar")
        for address in ("file:///etc/passwd", "ftp://example.org/x"):
            write(tmp_path / "r.toml", replace(ENTRY, addresses=(address,)))
            with pytest.raises(FetchError, match="expected an address of http or https"):
                read_registry(f"{server.url}/r.toml")
            with pytest.raises(FetchError, match="expected an address of http or https"):
                read_registry(tmp_path / "r.toml")


def test_unknown_names_are_told_the_nearest(tmp_path):
    registry = read_registry(write(tmp_path / "r.toml", ENTRY))
    with pytest.raises(FetchError, match=r"r.toml: has no entry 'flwoer'; it lists flower. Did you mean 'flower'\?"):
        registry.find("flwoer")
    with pytest.raises(FetchError, match="lists nothing yet. Give the registry that has it"):
        read_registry().find("flower")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('sha256 = "0', 'sha256 = "', r"entry.flower: .*regex.*`\$.sha256`"),
        ("size = 10", "size = 0", r"Expected `int` >= 1 - at `\$.size`"),
        ("size = 10", "size = true", r"Expected `int`, got `bool` - at `\$.size`"),
        ("unpacked = 8", "", r"missing required field `unpacked`"),
        ('kind = "run"', 'kind = "code"', r"run|data.* - at `\$.kind`"),
        ('file = "flower.tar"', 'file = "../flower.tar"', r"at `\$.file`"),
        ('licence = "CC-BY-4.0"', 'licence = " "', r"at `\$.licence`"),
        ('licence = "CC-BY-4.0"', 'licence = "a\\u001b[2J"', r"at `\$.licence`"),
        ('addresses = ["flower.tar", ', "addresses = [3, ", r"Expected `str`, got `int` - at `\$.addresses\[0\]`"),
        ("[entry.flower]", '[entry."../up"]', r"expected a table whose name has up to 64 letters"),
        ("size = 10", "size = 10\nurl = 'x'", r"unknown field `url`"),
        (SCHEMA, "another/2", r"field 'schema' is 'another/2', expected 'gausim.registry/1'"),
        ("kind =", "kind", r"cannot be read as TOML"),
        ("[entry.flower]", "[entries.flower]", r"expected 'schema' and tables \[entry.NAME\]"),
    ],
)
def test_wrong_fields_are_named(tmp_path, old, new, said):
    path = write(tmp_path / "r.toml", ENTRY)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(FetchError, match=said):
        read_registry(path)


def test_a_mirror_is_a_folder_or_a_url(tmp_path):
    assert mirrored(ENTRY, str(tmp_path)) == str(tmp_path / "flower.tar")
    assert mirrored(ENTRY, "https://example.org/m/?key=1") == "https://example.org/m/flower.tar?key=1"
    with pytest.raises(FetchError, match="--mirror .*nowhere: expected a folder, or a URL"):
        mirrored(ENTRY, str(tmp_path / "nowhere"))
