"""Damage to files: of their bytes, and of what the bytes mean, so that it gets past checksums and parsers."""

from __future__ import annotations

import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

WORDS = (b"\0" * 4, b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0\0\xc0\x7f", b"\0\0\x80\x7f",
         b"\0\0\0\0\0\0\xf8\x7f", b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\0\0\0\0\0\0\xf0\xff",
         b"\0\0\0\0\x01\0\0\0")  # fmt: skip
TOKENS = ("nan", "inf", "-inf", "1e999", "-1", "0", "1e308", "1e-320", "9" * 30, "9" * 400, "4294967296", "2147483648",
          "0x10", "1_000", "", "\N{ARABIC-INDIC DIGIT THREE}", "None", "\0", "true", "a b")  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 3.5, 1e308, -1e308, 1e-320, 10**18, 1 << 63, 10**400, float("nan"), float("inf"), "",
    "0", "x" * 5000, "../../etc/passwd", "\0", "\ud800", [], {}, [[]], [None], [0] * 1000, {"a": {}}, [[1, 2], [3]],
)  # fmt: skip
NUMBER = re.compile(rb"-?[0-9]+(\.[0-9]*)?([eE][+-]?[0-9]+)?")


def mutated(data: bytes, kind: str, rng: random.Random) -> bytes:
    """Another file, made of a good one; one to three things are wrong with it.

    ``kind`` is ``json``, ``text``, ``npz``, ``png`` or ``binary``: what may be damaged besides bytes.
    """
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        aware = MEANINGS.get(kind)
        if aware is not None and rng.random() < 0.7:
            try:
                data = aware(data, rng)
                continue
            except (ArithmeticError, EOFError, LookupError, RuntimeError, ValueError, struct.error, zipfile.BadZipFile,
                    zlib.error):  # an earlier damage went too deep for this one  # fmt: skip
                pass
        data = damaged(data, rng)
    return data


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Bytes changed, lost, doubled or put in, wherever."""
    if not data:
        return rng.randbytes(rng.randrange(1, 64))
    at = rng.randrange(len(data))
    # Headers decide most; they stand in front.
    at = at if rng.random() < 0.6 else at % min(len(data), 256)
    size = min(len(data) - at, rng.choice((1, 2, 4, 8, 16, 64, 256)))
    ways: tuple[Callable[[], bytes], ...] = (
        lambda: data[:at],
        lambda: data[:at] + data[at + size :],
        lambda: data[: at + size] + data[at:],
        lambda: data[:at] + rng.randbytes(size) + data[at + size :],
        lambda: data[:at] + rng.randbytes(size) + data[at:],
        lambda: data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :],
        lambda: data[:at] + (word := rng.choice(WORDS)) + data[at + len(word) :],
        lambda: data + rng.randbytes(size),
    )
    return rng.choice(ways)()


def _json(data: bytes, rng: random.Random) -> bytes:
    """A value, a key or a nesting of a JSON text is another."""
    tree = json.loads(data)
    places = list(_places(tree))
    way = rng.randrange(9)
    if way == 0:
        return b"[" * rng.choice((10, 2000, 200_000))
    if way == 1:
        return json.dumps(rng.choice(VALUES)).encode()
    holder, key = rng.choice(places)
    if way == 2 and isinstance(holder, dict):
        del holder[key]
    elif way == 3 and isinstance(holder, dict):
        holder[rng.choice((key + "x", "", key.upper()))] = holder.pop(key)
    elif way == 4 and isinstance(holder, list):
        holder.insert(key, holder[rng.randrange(len(holder))])
    elif way == 5 and isinstance(holder, list):
        del holder[key]
    elif way == 6:
        other, place = rng.choice(places)
        holder[key] = json.loads(json.dumps(other[place]))
    elif way == 7 and isinstance(holder[key], int | float):
        holder[key] = -holder[key] if rng.random() < 0.5 else holder[key] * rng.choice((0, 1.5, 1e6, 1e30))
    else:
        holder[key] = rng.choice(VALUES)
    return json.dumps(tree).encode()


def _places(tree: Any) -> list[tuple[Any, Any]]:
    found, todo = [], [tree]
    while todo:
        node = todo.pop()
        keys = node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        for key in keys:
            found.append((node, key))
            todo.append(node[key])
    return found


def _text(data: bytes, rng: random.Random) -> bytes:
    """A number, a word or a line of a text is another."""
    way = rng.randrange(4)
    if way == 0:
        lines = data.split(b"\n")
        at = rng.randrange(len(lines))
        lines[at : at + 1] = rng.choice(([], [lines[at]] * 2, [b""], [rng.choice(lines)], [lines[at] * 3]))
        return b"\n".join(lines)
    pattern = NUMBER if way < 3 else re.compile(rb"[A-Za-z_]+")
    found = list(pattern.finditer(data))
    match = rng.choice(found)
    token = rng.choice(TOKENS).encode() if way < 3 else rng.choice(found)[0]
    return data[: match.start()] + token + data[match.end() :]


def _npz(data: bytes, rng: random.Random) -> bytes:
    """A member of an archive is damaged, renamed or lost; the archive's own checksums fit."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    at, way = rng.randrange(len(members)), rng.randrange(4)
    name, content = members[at]
    if way == 0:
        members.pop(at)
    elif way == 1:
        members[at] = (rng.choice((name + "x", "x.npy", "../x.npy", "a/b.npy")), content)
    elif way == 2:  # the text that states type and shape
        end = 10 + struct.unpack("<H", content[8:10])[0]
        swaps = ((b"<f4", rng.choice((b"<f8", b"<i4", b"|O ", b">f4", b"<M8"))), (b"|b1", b"|u1"), (b"False", b"True "),
                 (b"(", rng.choice((b"(-", b"(9999999999,", b"(0,", b"(1,"))), (b",", b"0,"))  # fmt: skip
        old, new = rng.choice(swaps)
        head = content[:end].replace(old, new, 1)
        head = (head[: end - 1].ljust(end - 1) + b"\n") if len(head) <= end else head
        members[at] = (name, head + content[end:])
    else:
        members[at] = (name, damaged(content, rng))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for member, bytes_ in members:
            archive.writestr(member, bytes_)
    return buffer.getvalue()


def _png(data: bytes, rng: random.Random) -> bytes:
    """A chunk is damaged, lost, doubled or of another name; its checksum fits."""
    chunks, at = [], 8
    while at < len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    place, way = rng.randrange(len(chunks)), rng.randrange(5)
    name, body = chunks[place]
    if way == 0:
        chunks.pop(place)
    elif way == 1:
        chunks.insert(place, chunks[place])
    elif way == 2:
        width, height = (rng.choice((0, 1, 7, 8, 4096, 1 << 16, 1 << 30, (1 << 32) - 1)) for _ in range(2))
        rest = bytes([rng.choice((1, 8, 16)), rng.choice((0, 2, 3, 4, 6)), 0, 0, rng.choice((0, 1))])
        chunks[0] = (b"IHDR", struct.pack(">II", width, height) + rest)
    elif way == 3:
        chunks[place] = (rng.choice((b"IDAT", b"PLTE", b"tRNS", b"iCCP", b"eXIf", b"IEND")), body)
    else:
        chunks[place] = (name, damaged(body, rng))
    made = [struct.pack(">I", len(b)) + n + b + struct.pack(">I", zlib.crc32(n + b)) for n, b in chunks]
    return data[:8] + b"".join(made)


MEANINGS: dict[str, Callable[[bytes, random.Random], bytes]] = {"json": _json, "text": _text, "npz": _npz, "png": _png}
