"""Checkpoints: written so that a crash cannot spoil them, read without executing anything, tied to their scenes."""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import CheckpointIO
from torch import Tensor, nn

from gausim.core import GaussianScene, RunError


class AtomicCheckpointIO(CheckpointIO):
    """Writes beside the target, flushes to the disk, reads back, and only then renames.

    Whatever fails on the way, the previous file of that name stays. Only tensors and plain containers are written:
    loading needs ``weights_only`` and nothing more.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Writes a checkpoint.

        Raises:
            RunError: the disk refuses, or what was written cannot be read back; the previous file is untouched.
        """
        target = Path(path)
        temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with temporary.open("wb") as file:
                torch.save(checkpoint, file)
                file.flush()
                os.fsync(file.fileno())
            written = torch.load(temporary, map_location="cpu", weights_only=True)
            _check_equal(written.get("state_dict", {}), checkpoint.get("state_dict", {}))
            os.replace(temporary, target)
            _sync_directory(target.parent)
        except (OSError, RuntimeError, ValueError, pickle.PickleError) as error:
            raise RunError(
                f"{target}: the checkpoint could not be written ({error}). The previous one, if any, is unharmed. "
                "Check the free space and the permissions."
            ) from error
        finally:
            temporary.unlink(missing_ok=True)

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Reads a checkpoint; never executes what is in it."""
        return read_checkpoint(Path(path), map_location)

    def remove_checkpoint(self, path: str | Path) -> None:
        """Deletes a checkpoint."""
        Path(path).unlink(missing_ok=True)


def read_checkpoint(path: Path, map_location: Any = None) -> dict[str, Any]:
    """Reads a checkpoint that :class:`AtomicCheckpointIO` wrote, to the CPU unless told otherwise.

    Raises:
        RunError: it is missing, damaged or no checkpoint of gausim.
    """
    try:
        loaded = torch.load(path, map_location=map_location or "cpu", weights_only=True)
    except FileNotFoundError as error:
        raise RunError(f"{path}: no such checkpoint. Train first (`gausim train`).") from error
    except (OSError, RuntimeError, ValueError, EOFError, pickle.PickleError) as error:
        raise RunError(
            f"{path}: cannot be read as a checkpoint ({str(error).splitlines()[0]}). It is damaged."
        ) from error
    if not isinstance(loaded, dict) or "state_dict" not in loaded or "gausim" not in loaded:
        raise RunError(f"{path}: expected a checkpoint of gausim (entries 'state_dict' and 'gausim').")
    return loaded


def _check_equal(written: dict[str, Any], given: dict[str, Any]) -> None:
    different = [
        k for k, v in given.items() if isinstance(v, Tensor) and not _same(written.get(k), v.detach().cpu())
    ]  # fmt: skip
    if set(written) != set(given) or different:
        raise RuntimeError(f"read back with other contents: {different or sorted(set(written) ^ set(given))}")


def _same(first: Any, second: Tensor) -> bool:
    # Bytes, not values: a NaN read back is the same NaN.
    return isinstance(first, Tensor) and first.dtype == second.dtype and torch.equal(_bytes(first), _bytes(second))


def _bytes(value: Tensor) -> Tensor:
    return value.contiguous().reshape(-1).view(torch.uint8) if value.numel() else value.reshape(-1)


def _sync_directory(folder: Path) -> None:
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def fingerprints(scenes: Sequence[GaussianScene]) -> list[dict[str, Any]]:
    """What tells a scene from another: its name, number of kernels, pinned kernels and a hash of its means."""
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
    """Refuses a checkpoint that was trained on other scenes.

    Raises:
        RunError: naming the scenes of both.
    """
    own = checkpoint.get("gausim")
    if own is None:
        raise RunError(f"{source}: expected a checkpoint of gausim, found none of its entries.")
    trained, given = own["scenes"], fingerprints(scenes)
    if trained != given:
        raise RunError(
            f"{source} was trained on {_tell(trained)}, but the data holds {_tell(given)}. Give the scene it was "
            "trained on (data.root, data.scene), or train anew under another name."
        )


def _tell(prints: Sequence[dict[str, Any]]) -> str:
    return "; ".join(
        f"'{p['name']}' ({p['kernels']} kernels, {p['pinned']} pinned, means {p['means']})" for p in prints
    )  # fmt: skip


class WeightAverage:
    """An exponential moving average of the parameters; off where the decay is 0."""

    def __init__(self, decay: float) -> None:
        """``decay`` per optimiser step; it starts smaller so that the beginning is soon forgotten."""
        self._decay, self._steps = decay, 0
        self._values: dict[str, Tensor] = {}

    @torch.no_grad()
    def update(self, module: nn.Module) -> None:
        """Takes the parameters of a module in."""
        if self._decay == 0:
            return
        self._steps += 1
        decay = min(self._decay, (1 + self._steps) / (10 + self._steps))
        for name, parameter in module.named_parameters():
            if name not in self._values:
                self._values[name] = parameter.detach().clone()
            else:
                # A loaded average lies on the CPU until its first update.
                self._values[name] = self._values[name].to(parameter).lerp_(parameter.detach(), 1 - decay)

    def state_dict(self) -> dict[str, Any]:
        """The averaged parameters by name (none where it is off) and the steps taken."""
        return {"steps": self._steps, "values": dict(self._values)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from ``state``."""
        self._steps = int(state["steps"])
        self._values = dict(state["values"])


def load_weights(module: nn.Module, checkpoint: dict[str, Any], *, averaged: bool = True) -> None:
    """Loads the weights of a checkpoint into a module, the averaged ones where there are any.

    Raises:
        RunError: the checkpoint has other parameters than the module.
    """
    weights = dict(checkpoint["state_dict"])
    if averaged:
        weights.update(checkpoint["gausim"]["average"]["values"])
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        raise RunError(f"the checkpoint does not fit the model of its config: {error}") from error
