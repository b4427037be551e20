"""Reads what an offline run of Weights & Biases has written: LevelDB's log format, one protocol buffer per record.

Another process writes the file, so its end may be a part of a record: reading ends before it.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_BLOCK, _HEAD = 32768, 7


def records(path: Path) -> Iterator[Any]:
    from wandb.proto import wandb_internal_pb2

    data, place, parts = path.read_bytes(), _HEAD, b""
    while place + _HEAD <= len(data):
        if _BLOCK - place % _BLOCK < _HEAD:
            place += _BLOCK - place % _BLOCK
            continue
        _, length, kind = struct.unpack("<IHB", data[place : place + _HEAD])
        body = data[place + _HEAD : place + _HEAD + length]
        if len(body) < length:
            return
        place += _HEAD + length
        parts = parts + body if kind in (3, 4) else body  # 1 whole, 2 first, 3 middle, 4 last
        if kind in (1, 4):
            record = wandb_internal_pb2.Record()
            record.ParseFromString(parts)
            yield record


def read_offline_run(folder: Path) -> dict[str, Any]:
    """``run``: its record, ``config``, ``rows``: the history in its order, ``exits``: exit codes."""
    (path,) = folder.glob("*.wandb")
    found: dict[str, Any] = {"run": None, "config": {}, "rows": [], "exits": []}
    for record in records(path):
        kind = record.WhichOneof("record_type")
        if kind == "run":
            found["run"] = found["run"] or record.run
            found["config"] |= {u.key: json.loads(u.value_json) for u in record.run.config.update}
        elif kind == "history":
            row: dict[str, Any] = {}
            for item in record.history.item:
                names = list(item.nested_key) or [item.key]
                row["/".join(names)] = json.loads(item.value_json)
            found["rows"].append(row)
        elif kind == "exit":
            found["exits"].append(record.exit.exit_code)
    return found
