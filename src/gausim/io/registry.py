"""Registries: TOML files with the addresses and hashes of published runs and data sets.

docs/reference/files.md has an example.
"""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urljoin, urlsplit

import msgspec
from msgspec import Meta, Struct

from gausim.core.errors import FetchError
from gausim.io.download import is_url, read_text

SCHEMA = "gausim.registry/1"
SHIPPED = Path(__file__).with_name("registry.toml")
MOST_BYTES = 1 << 20
# Names are also used for files and folders.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_FILE = r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}"
_Bytes = Annotated[int, Meta(gt=0)]
_Line = Annotated[str, Meta(pattern=r"^[^\s\x00-\x1f\x7f-\x9f][^\x00-\x1f\x7f-\x9f]*\Z")]
_Address = Annotated[str, Meta(min_length=1)]


class Entry(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One published archive."""

    name: str  # name on the command line
    kind: Annotated[str, Meta(pattern=r"^(run|data)\Z")]  # ``run`` or ``data``
    title: _Line  # description in one line
    file: Annotated[str, Meta(pattern=rf"^{_FILE}\Z")]  # name of the archive
    addresses: tuple[_Address, ...] = ()  # URLs or paths, in the order to try
    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]  # of the archive, in hexadecimal
    size: _Bytes  # of the archive [bytes]
    unpacked: _Bytes  # of all files in it [bytes]
    licence: _Line  # an SPDX identifier or free text
    card: str = ""  # URL or path of its card; empty without one
    data: str = ""  # of a run, the entry of its data set, or empty


@dataclass(frozen=True)
class Registry:
    """Content of a registry."""

    source: str  # its file or URL
    entries: dict[str, Entry]  # by name, in the file's order

    def find(self, name: str) -> Entry:
        """The entry of a name.

        Raises:
            FetchError: there is no such entry; the message suggests the nearest name.
        """
        if name in self.entries:
            return self.entries[name]
        near = difflib.get_close_matches(name, self.entries, n=1)
        known = f"it lists {', '.join(self.entries)}" if self.entries else "it lists nothing yet"
        hint = f"Did you mean {near[0]!r}?" if near else "Give the registry that has it with --registry FILE|URL."
        raise FetchError(f"{self.source}: has no entry {name!r}; {known}. {hint}")


def read_registry(source: str | Path = SHIPPED) -> Registry:
    """Reads a registry from a path or a URL of http or https; relative addresses start at its location.

    Raises:
        FetchError: the registry is unreachable, or a field is missing or wrong.
    """
    source = str(source)
    text = read_text(source, most_bytes=MOST_BYTES)
    try:
        loaded = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise FetchError(f"{source}: cannot be read as TOML ({error}).") from error
    if loaded.get("schema") != SCHEMA:
        raise FetchError(f"{source}: field 'schema' is {loaded.get('schema')!r}, expected {SCHEMA!r}.")
    strange = sorted(set(loaded) - {"schema", "entry"})
    entries = loaded.get("entry", {})
    if strange or not isinstance(entries, dict):
        raise FetchError(f"{source}: expected 'schema' and tables [entry.NAME], found {strange or 'another entry'}.")
    return Registry(source, {name: _entry(source, name, fields) for name, fields in entries.items()})


def _entry(source: str, name: str, fields: Any) -> Entry:
    where = f"{source}: entry.{name}"
    if not _NAME.fullmatch(name) or not isinstance(fields, dict):
        raise FetchError(f"{where}: expected a table whose name has up to 64 letters, digits, '-' and '_'.")
    try:
        entry = msgspec.convert({**fields, "name": name}, Entry)
    except msgspec.ValidationError as error:
        raise FetchError(f"{where}: {error}. Correct it, or tell whoever keeps the registry.") from error
    addresses = tuple(_absolute(where, address, source) for address in entry.addresses)
    card = _absolute(where, entry.card, source) if entry.card else ""
    return msgspec.structs.replace(entry, addresses=addresses, card=card)


def _absolute(where: str, address: str, source: str) -> str:
    """An address, made absolute by the registry's location; registries on the web cannot refer to local files."""
    if is_url(source):
        address = urljoin(source, address)
    elif not is_url(address) and "://" not in address:
        return str(Path(source).parent / address)
    if not is_url(address):
        raise FetchError(f"{where}: expected an address of http or https or a relative path, got {address!r}.")
    return address


def mirrored(entry: Entry, mirror: str) -> str:
    """Address of the archive of an entry on a mirror, which is a folder or the URL of one.

    Raises:
        FetchError: the mirror is neither a folder nor a URL of http or https.
    """
    if is_url(mirror):
        parts = urlsplit(mirror)
        return parts._replace(path=f"{parts.path.rstrip('/')}/{entry.file}").geturl()
    if not Path(mirror).is_dir():
        raise FetchError(f"--mirror {mirror}: expected a folder, or a URL of http or https, found neither.")
    return str(Path(mirror) / entry.file)


def check_name(name: str) -> None:
    """Checks the name of an entry.

    Raises:
        FetchError: the name is invalid.
    """
    if not _NAME.fullmatch(name):
        raise FetchError(f"--name {name}: expected up to 64 letters, digits, '-' and '_', a letter or digit first.")


def entry_text(entry: Entry) -> str:
    """TOML text of an entry."""
    fields = {key: value for key, value in msgspec.structs.asdict(entry).items() if value != "" or key == "card"}
    # JSON's strings, numbers and lists of strings are valid TOML.
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in fields.items() if key != "name"]
    return "\n".join([f"[entry.{entry.name}]", *lines, ""])
