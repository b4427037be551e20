"""SHA-256 of nested containers of tensors and plain values, to compare checkpoints bit by bit."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


def digest(content: Any) -> str:
    """Bytes, types, shapes and order enter."""
    running = hashlib.sha256()
    _feed(running, content, "checkpoint")
    return running.hexdigest()


def _feed(running: Any, value: Any, where: str) -> None:
    if isinstance(value, Tensor):
        flat = value.detach().cpu().contiguous().reshape(-1)
        running.update(f"tensor {value.dtype} {tuple(value.shape)}".encode())
        running.update(flat.view(torch.uint8).numpy() if flat.numel() else b"")
    elif isinstance(value, Mapping):
        running.update(f"mapping {len(value)}".encode())
        for key, entry in value.items():
            _feed(running, key, where)
            _feed(running, entry, f"{where}[{key!r}]")
    elif isinstance(value, (list, tuple)):
        running.update(f"{'list' if isinstance(value, list) else 'tuple'} {len(value)}".encode())
        for place, entry in enumerate(value):
            _feed(running, entry, f"{where}[{place}]")
    elif value is None or type(value) in (bool, int, float, str, bytes):
        running.update(f"{type(value).__name__} {value!r};".encode())
    else:
        raise TypeError(f"{where} holds a {type(value).__name__}; expected tensors, containers and plain values")
