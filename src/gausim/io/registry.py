"""Registries: TOML files that say where published runs and data sets lie, and by what hash they are known.

::

    schema = "gausim.registry/1"

    [entry.bunny]
    kind = "run"                       # or "data"
    title = "The Blender bunny, neural simulator"
    file = "bunny.tar"                 # name of the archive, also in a mirror
    addresses = ["bunny.tar"]          # URLs, or paths relative to this registry; the first that answers counts
    sha256 = "…"                       # of the archive, 64 hexadecimal digits
    size = 4608000                     # of the archive [bytes]
    unpacked = 4590312                 # of all files in it together [bytes]
    licence = "CC-BY-4.0"
    card = "bunny.md"                  # where its card can be read, like an address; may be empty
    data = "bunny-data"                # of a run: the entry of the data set that it was trained on; may be left out
"""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

from gausim.core.errors import FetchError
from gausim.io.download import is_url, read_text

SCHEMA = "gausim.registry/1"
SHIPPED = Path(__file__).with_name("registry.toml")
KINDS = ("run", "data")
MOST_BYTES = 1 << 20
# Both become names of files and folders.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_FILE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One published archive.

    Attributes:
        name: how it is asked for.
        kind: ``run`` or ``data``.
        title: what it is, in one line.
        file: name of the archive.
        addresses: where it lies, in the order to try: URLs or paths.
        sha256: of the archive, in hexadecimal.
        size: of the archive [bytes].
        unpacked: of all files in it [bytes].
        licence: an SPDX identifier, or words.
        card: URL or path of its card; empty without one.
        data: of a run, the entry of its data set; empty where none is named.
    """

    name: str
    kind: str
    title: str
    file: str
    sha256: str
    size: int
    unpacked: int
    licence: str
    addresses: tuple[str, ...] = ()
    card: str = ""
    data: str = ""


@dataclass(frozen=True)
class Registry:
    """What a registry lists.

    Attributes:
        source: its file or URL.
        entries: by name, in the file's order.
    """

    source: str
    entries: dict[str, Entry]

    def find(self, name: str) -> Entry:
        """The entry of a name.

        Raises:
            FetchError: there is none; the nearest name is told.
        """
        if name in self.entries:
            return self.entries[name]
        near = difflib.get_close_matches(name, self.entries, n=1)
        known = f"it lists {', '.join(self.entries)}" if self.entries else "it lists nothing yet"
        hint = f"Did you mean {near[0]!r}?" if near else "Give the registry that has it with --registry FILE|URL."
        raise FetchError(f"{self.source}: has no entry {name!r}; {known}. {hint}")


def read_registry(source: str | Path = SHIPPED) -> Registry:
    """Reads a registry.

    Args:
        source: a path or a URL of http or https. Relative addresses in it start where it lies.

    Raises:
        FetchError: it cannot be had, or a field is missing or wrong.
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
    problem = _problem(fields)
    if problem is not None:
        raise FetchError(f"{where}.{problem}. Correct it, or tell whoever keeps the registry.")
    addresses = tuple(_absolute(where, address, source) for address in fields.get("addresses", ()))
    card = fields.get("card", "")
    own = {key: value for key, value in fields.items() if key not in ("addresses", "card")}
    return Entry(name=name, addresses=addresses, card=_absolute(where, card, source) if card else "", **own)


def _problem(fields: Mapping[str, Any]) -> str | None:
    """The first field that is wrong, what was expected and what was found."""
    texts, numbers = ("kind", "title", "file", "sha256", "licence"), ("size", "unpacked")
    optional = {"addresses": list, "card": str, "data": str}
    for key in fields:
        if key not in (*texts, *numbers, *optional):
            return f"{key}: unknown field"
        if key in optional and not isinstance(fields[key], optional[key]):
            return f"{key}: expected a {optional[key].__name__}, got {fields[key]!r}"
    for key in texts:
        if not isinstance(fields.get(key), str) or not fields[key].strip() or not fields[key].isprintable():
            return f"{key}: expected a text, got {fields.get(key)!r}"
    for key in numbers:
        if type(fields.get(key)) is not int or fields[key] <= 0:
            return f"{key}: expected a number of bytes, got {fields.get(key)!r}"
    if fields["kind"] not in KINDS:
        return f"kind: expected one of {', '.join(KINDS)}, got {fields['kind']!r}"
    if not _SHA256.fullmatch(fields["sha256"]):
        return f"sha256: expected 64 hexadecimal digits in lower case, got {fields['sha256']!r}"
    if not _FILE.fullmatch(fields["file"]):
        return f"file: expected the name of a file without folders, got {fields['file']!r}"
    if not all(isinstance(address, str) and address for address in fields.get("addresses", ())):
        return f"addresses: expected a list of URLs or paths, got {fields['addresses']!r}"
    return None


def _absolute(where: str, address: str, source: str) -> str:
    """An address as seen from where the registry lies; a registry of the web can name nothing on this machine."""
    if is_url(source):
        address = urljoin(source, address)
    elif not is_url(address) and "://" not in address:
        return str(Path(source).parent / address)
    if not is_url(address):
        raise FetchError(f"{where}: expected an address of http or https or a relative path, got {address!r}.")
    return address


def mirrored(entry: Entry, mirror: str) -> str:
    """Where a mirror, a folder or the URL of one, has the archive of an entry.

    Raises:
        FetchError: the mirror is neither a folder nor a URL of http or https.
    """
    if is_url(mirror):
        parts = urlsplit(mirror)
        return parts._replace(path=f"{parts.path.rstrip('/')}/{entry.file}").geturl()
    if not Path(mirror).is_dir():
        raise FetchError(f"--mirror {mirror}: expected a folder, or a URL of http or https, found neither.")
    return str(Path(mirror) / entry.file)


def check_names(name: str, file: str) -> None:
    """Refuses what no registry may call an entry and its archive.

    Raises:
        FetchError: naming it.
    """
    if not _NAME.fullmatch(name) or not _FILE.fullmatch(file):
        raise FetchError(f"--name {name}: expected up to 64 letters, digits, '-' and '_', a letter or digit first.")


def entry_text(entry: Entry) -> str:
    """An entry as it stands in a registry."""
    fields = {key: getattr(entry, key) for key in ("kind", "title", "file", "addresses", "sha256")}
    fields |= {key: getattr(entry, key) for key in ("size", "unpacked", "licence", "card", "data")}
    lines = [f"[entry.{entry.name}]"]
    for key, value in fields.items():
        if value != "" or key == "card":
            # JSON's texts, numbers and lists of texts are TOML's too.
            lines.append(f"{key} = {json.dumps(value, ensure_ascii=False)}")
    return "\n".join(lines) + "\n"
