"""Trajectories as safetensors files: bit-exact, and without executable content."""

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from gausim.core import DataError, Trajectory
from gausim.io.files import write_durably

FORMAT = "gausim.trajectory/1"
# Names in the file, which users have on disk, and those of Trajectory.
_TENSORS = {"positions": "positions", "gradients": "deformation_gradients", "rotations": "rotations",
            "unit_of_kernel": "unit_of_kernel"}  # fmt: skip


def save_trajectory(path: Path | str, trajectory: Trajectory, *, facts: Mapping[str, str] | None = None) -> None:
    """Writes a trajectory, with ``facts`` (e.g. object and sequence) in its header; replaces the file atomically."""
    tensors = {name: getattr(trajectory, key).detach().cpu().contiguous() for name, key in _TENSORS.items()}
    tensors["fps"] = torch.tensor(trajectory.fps, dtype=torch.float64)
    write_durably(Path(path), save(tensors, metadata={**(facts or {}), "format": FORMAT}))


def load_trajectory(path: Path | str) -> Trajectory:
    """Reads a trajectory.

    Raises:
        DataError: the file is missing, not safetensors, of another format, or a tensor is missing or malformed.
    """
    path = Path(path)
    try:
        with safe_open(str(path), framework="pt") as file:
            found, metadata = set(file.keys()), file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in (*_TENSORS, "fps") if name in found}
    except FileNotFoundError:
        raise DataError(f"{path}: no such file. Write one with `gausim simulate RUN`.") from None
    except (OSError, SafetensorError) as error:
        raise DataError(f"{path}: cannot be read as safetensors ({error}). Copy or export it again.") from error
    if metadata.get("format") != FORMAT:
        raise DataError(f"{path}: header 'format' is {metadata.get('format')!r}, expected {FORMAT!r}.")
    missing = [name for name in (*_TENSORS, "fps") if name not in found]
    if missing:
        raise DataError(f"{path}: tensor '{missing[0]}' is missing; it has {sorted(found)}. Export it again.")
    _check(path, tensors)
    return Trajectory(**{key: tensors[name] for name, key in _TENSORS.items()}, fps=float(tensors["fps"]))


def _check(path: Path, tensors: dict[str, Tensor]) -> None:
    frames, kernels = tensors["positions"].shape[:1], tensors["unit_of_kernel"].shape[:1]
    units, index, fps = tensors["gradients"].shape[1:2], tensors["unit_of_kernel"], tensors["fps"]
    maps = (*frames, *units, 3, 3)
    expected = {"positions": (*frames, *kernels, 3), "gradients": maps, "rotations": maps, "unit_of_kernel": kernels}
    for name, shape in {**expected, "fps": ()}.items():
        actual = tuple(tensors[name].shape)
        if actual != tuple(shape):
            raise DataError(f"{path}: tensor '{name}' has shape {actual}, expected {tuple(shape)}. Export it again.")
        if tensors[name] is not index and not (tensors[name].is_floating_point() and tensors[name].isfinite().all()):
            raise DataError(f"{path}: tensor '{name}' holds values that are no finite numbers. Simulate it again.")
    if index.is_floating_point() or (len(index) and not 0 <= int(index.min()) <= int(index.max()) < units[0]):
        raise DataError(f"{path}: tensor 'unit_of_kernel' must hold indices of {units[0]} units. Export it again.")
    if float(fps) <= 0:
        raise DataError(f"{path}: tensor 'fps' is {float(fps)}, expected a positive number. Export it again.")
