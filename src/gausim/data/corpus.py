"""A corpus of elastic bodies with known motion and material: safetensors shards beside a ``manifest.json``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Bool, Float
from msgspec import Meta, Struct
from safetensors import SafetensorError, safe_open
from torch import Tensor

from gausim.core import DataError
from gausim.io.plain_json import checked, read_json

MANIFEST = "manifest.json"
SCHEMA = "gausim.corpus/1"
REMEDY = "Make the corpus again with `gausim prepare corpus`."
# Tensors of a body in its shard, named NAME.FIELD; K kernels, S sequences, F frames.
_MATERIAL = dict.fromkeys(("scale", "stiffness", "density", "damping"), (torch.float32, "K"))
FIELDS = {
    "rest": (torch.float32, "K3"),
    "pinned": (torch.bool, "K"),
    **_MATERIAL,
    "displacement": (torch.float16, "SFK3"),
}
_Count = Annotated[int, Meta(ge=1)]
_Size = Annotated[float, Meta(gt=0, le=1e9)]
_Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z")]
Kind = Literal["poke", "drag", "twist"]  # around a point, growing away from the pins, about an axis
Start = Literal["impulse", "release"]  # frame 0 is at rest, or at the first turn of the motion


class PushRecord(Struct, frozen=True, forbid_unknown_fields=True):
    """The push that set a sequence off."""

    kind: Kind
    start: Start
    direction: tuple[float, float, float]  # of the push, or the axis of a twist; unit length
    swing: _Size  # largest displacement of a kernel in the sequence [diagonals]


class BodyRecord(Struct, frozen=True, forbid_unknown_fields=True):
    """Facts about one body."""

    name: _Name  # prefix of its tensors
    shard: _Name  # file that holds it
    shape: str  # kind of its shape, such as ``fork``
    pins: str  # kind of its pins
    material: str  # ``even``, ``split`` or ``halves`` (two materials), or ``smooth``
    contrast: _Size  # largest stiffness over the smallest
    kernels: _Count
    sequences: _Count
    frames: _Count
    fps: _Size
    diagonal: _Size  # of the bounding box of its rest shape [scene units]
    poisson_ratio: float
    period: _Size  # of its slowest mode [frames]
    swing: _Size  # largest displacement of a kernel [diagonals]
    pushes: tuple[PushRecord, ...]  # one per sequence
    redrawn: int  # bodies and pushes that were drawn before and not kept


class Manifest(Struct, frozen=True, forbid_unknown_fields=True):
    """Content of ``manifest.json``."""

    schema: str
    seed: int
    settings: dict[str, object]
    redrawn: int  # bodies and pushes that exploded or hardly moved
    bodies: Annotated[tuple[BodyRecord, ...], Meta(min_length=1)]


@dataclass(frozen=True, eq=False)
class CorpusBody:
    """One body and its motion."""

    name: str
    fps: float  # frames per second
    rest: Float[Tensor, "K 3"]  # positions at rest [scene units]
    pinned: Bool[Tensor, " K"]  # kernels that never move
    scale: Float[Tensor, " K"]  # standard deviation of the isotropic kernels [scene units]
    stiffness: Float[Tensor, " K"]  # Young's modulus [mass / (scene unit s^2)]
    density: Float[Tensor, " K"]  # [mass / scene unit^3]
    damping: Float[Tensor, " K"]  # force over momentum; amplitudes fall as exp(-damping t / 2) [1/s]
    positions: Float[Tensor, "S F K 3"]  # [scene units]
    record: BodyRecord


class Corpus:
    """The bodies in the folder ``path``, read one by one; ``manifest`` is the content of its manifest."""

    def __init__(self, path: Path | str) -> None:
        """Reads the manifest; a :class:`DataError` says that it is missing or malformed, or a shard is missing."""
        self.path = Path(path)
        file = self.path / MANIFEST
        if not file.is_file():
            raise DataError(f"{file}: not found. Make a corpus with `gausim prepare corpus --out {self.path}`.")
        data = read_json(file)
        found = data.get("schema")
        if found != SCHEMA:
            raise DataError(f"{file}: field 'schema' is {found!r}, expected {SCHEMA!r}. {REMEDY}")
        self.manifest: Manifest = checked(data, Manifest, str(file), REMEDY)
        for shard in sorted({body.shard for body in self.manifest.bodies}):
            if not (self.path / shard).is_file():
                raise DataError(f"{self.path / shard}: not found, though {MANIFEST} names it. {REMEDY}")

    def __len__(self) -> int:
        return len(self.manifest.bodies)

    def body(self, index: int) -> CorpusBody:
        """One body; nothing else of its shard is read.

        Raises:
            IndexError: there is no such body.
            DataError: the shard is damaged, or a tensor of the body is missing or malformed.
        """
        record = self.manifest.bodies[index]
        path = self.path / record.shard
        try:
            with safe_open(str(path), framework="pt") as file:
                missing = sorted({f"{record.name}.{field}" for field in FIELDS} - set(file.keys()))
                if missing:
                    raise DataError(f"{path}: tensor '{missing[0]}' is missing. {REMEDY}")
                tensors = {field: file.get_tensor(f"{record.name}.{field}") for field in FIELDS}
        except (OSError, SafetensorError) as error:
            raise DataError(f"{path}: cannot be read as safetensors ({error}). {REMEDY}") from error
        _check(f"{path}: tensor '{record.name}.", tensors, record)
        positions = tensors["rest"] + tensors.pop("displacement").float() * record.diagonal
        return CorpusBody(name=record.name, fps=record.fps, positions=positions, record=record, **tensors)


def _check(where: str, tensors: dict[str, Tensor], record: BodyRecord) -> None:
    sizes = {"K": record.kernels, "S": record.sequences, "F": record.frames, "3": 3}
    for name, (dtype, axes) in FIELDS.items():
        tensor, shape = tensors[name], tuple(sizes[axis] for axis in axes)
        if tuple(tensor.shape) != shape or tensor.dtype != dtype:
            found = f"{tensor.dtype} {tuple(tensor.shape)}"
            raise DataError(f"{where}{name}' is {found}, expected {dtype} {shape}. {REMEDY}")
        if not torch.isfinite(tensor).all():
            raise DataError(f"{where}{name}' has values that are no finite numbers. {REMEDY}")
        if name in ("scale", "stiffness", "density") and not (tensor > 0).all():
            raise DataError(f"{where}{name}' has values that are not positive. {REMEDY}")
