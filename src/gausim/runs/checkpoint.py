"""Checkpoints: written atomically, read without executing code, and checked against their scenes."""

from __future__ import annotations

import hashlib
import io
import pickle
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor, nn

from gausim.core import GaussianScene, RunError
from gausim.io.files import write_durably
from gausim.runs.names import LAST_CHECKPOINT

PREVIOUS_CHECKPOINT = "last.previous.ckpt"
DIGEST = "digest"


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes to a temporary file, flushes it to the disk, verifies it, and only then renames it.

    If a step fails, the previous file of that name stays and an error is raised. The predecessor of ``last.ckpt`` is
    kept as ``last.previous.ckpt``. Only tensors and plain containers are written, so that ``weights_only`` suffices for
    loading. A digest of the content is stored with them, because torch does not detect flipped bits of a tensor.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Writes a checkpoint; after a RunError the previous file is unchanged."""
        target, buffer = Path(path), io.BytesIO()
        try:
            expected = digest(checkpoint)
            torch.save({**checkpoint, DIGEST: expected}, buffer)
            write_durably(
                target,
                buffer.getvalue(),
                check=lambda written: _check_written(written, expected),
                previous=target.with_name(PREVIOUS_CHECKPOINT) if target.name == LAST_CHECKPOINT else None,
            )
        except (OSError, RuntimeError, ValueError, TypeError, AttributeError, pickle.PickleError, RunError) as error:
            raise RunError(
                f"{target}: the checkpoint could not be written ({error}). The previous one, if any, is unharmed. "
                "Check the free space and the permissions; then the same command continues from it."
            ) from error

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Reads a checkpoint to the CPU without executing code from it."""
        return read_checkpoint(Path(path))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Reads a checkpoint that :class:`AtomicCheckpointIO` wrote, to the CPU.

    Raises:
        RunError: the file is missing, damaged or not a checkpoint of gausim.
    """
    try:
        loaded = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise RunError(f"{path}: no such checkpoint. Train first (`gausim train`).") from error
    except pickle.UnpicklingError as error:
        # torch's message is not passed on: it recommends loading the file with code execution.
        raise _damaged(path, "it is no archive of tensors and plain containers; nothing in it was executed") from error
    except Exception as error:  # damage inside an archive can raise almost any exception
        raise _damaged(path, (str(error) or type(error).__name__).splitlines()[0]) from error
    if not isinstance(loaded, dict) or "state_dict" not in loaded or "gausim" not in loaded:
        raise RunError(f"{path}: expected a checkpoint of gausim (entries 'state_dict' and 'gausim').")
    expected, found = str(loaded.get(DIGEST)), digest({k: v for k, v in loaded.items() if k != DIGEST})
    if found != expected:
        raise _damaged(path, f"its content has digest {found[:12]}, expected {expected[:12]}")
    return loaded


def _damaged(path: Path, reason: str) -> RunError:
    return RunError(
        f"{path}: cannot be read as a checkpoint ({reason}). It is damaged, or not gausim's. The command that trained "
        f"it falls back to {PREVIOUS_CHECKPOINT} beside it, where there is one."
    )


def _check_written(path: Path, expected: str) -> None:
    if read_checkpoint(path).get(DIGEST) != expected:
        raise RuntimeError("it reads back with other contents")


def digest(content: Any) -> str:
    """SHA-256 of nested containers of tensors and plain values: bytes, types, shapes and order enter.

    Raises:
        TypeError: an object of another type, which could not be read back without executing code.
    """
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


def fingerprints(scenes: Sequence[GaussianScene]) -> list[dict[str, Any]]:
    """Fingerprints of scenes: name, number of kernels, pinned kernels and a hash of the means."""
    return [
        {
            "name": scene.name,
            "kernels": scene.count,
            "pinned": int(scene.pinned.sum()),
            "means": hashlib.sha256(scene.means.detach().cpu().float().contiguous().numpy().tobytes()).hexdigest()[:16],
        }
        for scene in scenes
    ]


def check_scenes(checkpoint: dict[str, Any], scenes: Sequence[GaussianScene], source: str) -> None:
    """Raises RunError for a checkpoint that was trained on other scenes; the message names both."""
    trained, given = checkpoint["gausim"]["scenes"], fingerprints(scenes)
    if trained != given:
        raise RunError(
            f"{source} was trained on {scene_text(trained)}, but the data holds {scene_text(given)}. Give the "
            "scene it was trained on (data.root, data.scene), or train anew under another name."
        )


def scene_text(prints: Sequence[dict[str, Any]]) -> str:
    """Text of fingerprints for messages."""
    texts = (f"'{p['name']}' ({p['kernels']} kernels, {p['pinned']} pinned, means {p['means']})" for p in prints)
    return "; ".join(texts)


class WeightAverage:
    """An exponential moving average of the parameters; off where the decay is 0."""

    def __init__(self, decay: float) -> None:
        """``decay`` per optimiser step; it starts smaller, so that initial weights are soon forgotten."""
        self._decay, self._steps = decay, 0
        self._values: dict[str, Tensor] = {}

    @torch.no_grad()
    def update(self, parameters: Iterable[tuple[str, nn.Parameter]]) -> None:
        """Averages in the current parameters, by name."""
        if self._decay == 0:
            return
        self._steps += 1
        decay = min(self._decay, (1 + self._steps) / (10 + self._steps))
        for name, parameter in parameters:
            if name not in self._values:
                self._values[name] = parameter.detach().clone()
            else:
                # A loaded average is on the CPU until its first update.
                self._values[name] = self._values[name].to(parameter).lerp_(parameter.detach(), 1 - decay)

    def state_dict(self) -> dict[str, Any]:
        """The averaged parameters by name (empty when off) and the number of steps."""
        return {"steps": self._steps, "values": dict(self._values)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from ``state``."""
        self._steps = int(state["steps"])
        self._values = dict(state["values"])


def averaged_weights(checkpoint: Mapping[str, Any]) -> dict[str, Tensor]:
    """The weights of a checkpoint by name; averaged weights take precedence."""
    return {**checkpoint["state_dict"], **checkpoint["gausim"]["average"]["values"]}


def load_weights(module: nn.Module, checkpoint: dict[str, Any]) -> None:
    """Loads the weights of a checkpoint into a module of equal parameters; averaged weights take precedence."""
    try:
        module.load_state_dict(averaged_weights(checkpoint))
    except RuntimeError as error:
        raise RunError(f"the checkpoint does not fit the model of its config: {error}") from error
