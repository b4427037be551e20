"""Checkpoints: written atomically, read without executing code, and checked against their scenes."""

import hashlib
import io
import pickle
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import nn

from gausim.core import GaussianScene, RunError
from gausim.io.files import write_durably
from gausim.runs.names import LAST_CHECKPOINT

PREVIOUS_CHECKPOINT = "last.previous.ckpt"


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes to a temporary file, flushes it to the disk, verifies it, and only then renames it.

    If a step fails, the previous file of that name stays and an error is raised. The predecessor of ``last.ckpt`` is
    kept as ``last.previous.ckpt``. Only tensors and plain containers are written, so that ``weights_only`` suffices for
    loading.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Writes a checkpoint; after a RunError the previous file is unchanged."""
        target, buffer = Path(path), io.BytesIO()
        try:
            torch.save(checkpoint, buffer)
            previous = target.with_name(PREVIOUS_CHECKPOINT) if target.name == LAST_CHECKPOINT else None
            write_durably(target, buffer.getvalue(), check=read_checkpoint, previous=previous)
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
        with zipfile.ZipFile(path) as archive:
            flipped = archive.testzip()  # torch does not compare the checksums that it writes
    except FileNotFoundError as error:
        raise RunError(f"{path}: no such checkpoint. Train first (`gausim train`).") from error
    except pickle.UnpicklingError as error:
        # torch's message is not passed on: it recommends loading the file with code execution.
        raise _damaged(path, "it is no archive of tensors and plain containers; nothing in it was executed") from error
    except Exception as error:  # damage inside an archive can raise almost any exception
        raise _damaged(path, (str(error) or type(error).__name__).splitlines()[0]) from error
    if not isinstance(loaded, dict) or "state_dict" not in loaded or "gausim" not in loaded:
        raise RunError(f"{path}: expected a checkpoint of gausim (entries 'state_dict' and 'gausim').")
    if flipped is not None:
        raise _damaged(path, f"the checksum of its part {flipped} is wrong")
    return loaded


def _damaged(path: Path, reason: str) -> RunError:
    return RunError(
        f"{path}: cannot be read as a checkpoint ({reason}). It is damaged, or not gausim's. The command that trained "
        f"it falls back to {PREVIOUS_CHECKPOINT} beside it, where there is one."
    )


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


def load_weights(module: nn.Module, checkpoint: dict[str, Any]) -> None:
    """Loads the weights of a checkpoint into a module of equal parameters.

    Raises:
        RunError: the parameters differ.
    """
    try:
        module.load_state_dict(checkpoint["state_dict"])
    except RuntimeError as error:
        raise RunError(f"the checkpoint does not fit the model of its config: {error}") from error
