"""One object of a data set: metadata, sequences, stills, true points and rest scene in one directory; its test part."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from msgspec import Meta, Struct
from torch import Tensor

from gausim.core import ConfigError, DataError, GaussianScene
from gausim.core.scene import LAWS
from gausim.data.records import GroundTruth, SequenceRecord, Stills, read_stills
from gausim.data.surroundings import gripped, read_surroundings
from gausim.io.files import safe_name
from gausim.io.npz import read_array
from gausim.io.plain_json import checked, read_json
from gausim.io.ply import MASK_NAMES, load_scene
from gausim.ops.selection import Selection, apply_masks, parse_half_space, require_pinned

PARTS = ("development", "test")


class _Facts(Struct):
    fps: Annotated[float, Meta(gt=0)]
    views: tuple[str, ...]
    train_views: tuple[str, ...]
    heldout_views: tuple[str, ...]
    # The first frame and the first unseen one.
    train_frames: tuple[Annotated[int, Meta(ge=0, le=0)], Annotated[int, Meta(ge=2, le=1 << 31)]]
    name: str = ""
    pinned_below_z: float | None = None
    law: Literal["solid", "springs"] | None = None


class ReservedPart(Struct, frozen=True, forbid_unknown_fields=True):
    """Sequences that training sees only the seen frames of, as images; nothing is tuned on the others."""

    sequences: tuple[str, ...] | Literal["all"] = "all"  # their names, or ``all``
    # only objects made from one of these seeds (field ``seed`` of ``dataset.json``) have a test part; null: every
    # object
    seeds: tuple[int, ...] | None = None

    def of(self, found: Sequence[str], seed: object, where: str) -> set[str]:
        """The reserved ones of the sequences ``found`` of an object that was made from ``seed``.

        Raises:
            DataError: a reserved sequence does not exist.
        """
        if self.seeds is not None and seed not in self.seeds:
            return set()
        if self.sequences == "all":
            return set(found)
        absent = sorted(set(self.sequences) - set(found))
        if absent:
            raise DataError(
                f"{where}: field 'test.sequences' reserves {absent}, the object has {list(found)}. Correct the names."
            )
        return set(self.sequences)


def reserved_part(value: Mapping[str, Any] | None, where: str) -> ReservedPart | None:
    """Reads a declaration; None if there is none.

    Raises:
        DataError: a field is unknown or wrong.
    """
    if value is None:
        return None
    remedy = "Expected {sequences: [NAME, ...] or all, seeds: [NUMBER, ...] or absent}."
    return checked(dict(value) if isinstance(value, Mapping) else value, ReservedPart, where, remedy)


class ObjectData:
    """A READY-like object directory (``dataset.json``, ``static/``, ``sequences/``, ``scene.ply``).

    Attributes:
        root: the directory.
        name: the object's name.
        fps: frames per second of its sequences.
        views: names of all cameras.
        train_views: cameras to train on.
        heldout_views: cameras never trained on.
        train_frames: the frames that training may see, e.g. range(0, 16).
        pinned_below_z: a reconstruction pins the kernels below this height [scene units]; None where not stated.
        law: its law of large deformations (:class:`gausim.core.GaussianScene`).
        facts: all other entries of ``dataset.json``.
        surroundings: what acts on the body besides its own elasticity.
        scene_path, masks_path: files of the rest scene and its masks; without the second the one beside the PLY.
        selections, test, sealed: as given.
    """

    def __init__(
        self,
        root: Path | str,
        *,
        sequences: int | Sequence[str] | None = None,
        scene: Path | str | None = None,
        masks: Path | str | None = None,
        selections: Mapping[str, Selection | str] | None = None,
        law: str | None = None,
        part: str | None = None,
        test: Mapping[str, Any] | None = None,
        sealed: bool = False,
    ) -> None:
        """Reads ``dataset.json``; all other files are read on first use.

        Args:
            root: the object's directory.
            sequences: number of sequences to use, or their names; all when None.
            scene: PLY of the rest scene; ``root/scene.ply`` when None.
            masks: npz of its masks; beside the PLY when None.
            selections: replacements of its masks, see :func:`gausim.data.objects.select_masks`.
            law: its law; that of ``dataset.json`` when None, else ``solid``.
            part: use only the sequences of the ``development`` or the ``test`` part; those of both when None.
            test: the test part, in addition to that of ``dataset.json`` (:class:`gausim.data.objects.ReservedPart`).
            sealed: refuse unseen frames and the true motion of the test part.

        Raises:
            ConfigError: the law is unknown.
            DataError: ``dataset.json`` is missing or has a wrong field.
        """
        if law not in (None, *LAWS):
            raise ConfigError(f"data.law: expected null, {' or '.join(LAWS)}, got '{law}'.")
        self.root = Path(root)
        path = self.root / "dataset.json"
        self.facts = read_json(path)
        found = checked(self.facts, _Facts, str(path), "Correct the field.")
        self.name, self.fps = safe_name(found.name, f"{path}: field 'name'") or self.root.name, found.fps
        for view in found.views:
            safe_name(view, f"{path}: field 'views'")
        self.views, self.train_views, self.heldout_views = found.views, found.train_views, found.heldout_views
        self.train_frames, self.pinned_below_z = range(*found.train_frames), found.pinned_below_z
        self.surroundings, self._grip = read_surroundings(self.facts, str(path))
        self.law: str = law or found.law or LAWS[0]
        self._check_views(path)
        self.scene_path = Path(scene) if scene is not None else self.root / "scene.ply"
        self.masks_path = Path(masks) if masks is not None else None
        self._chosen, self.selections, self.test, self.sealed = sequences, dict(selections or {}), test, sealed
        if part not in (None, *PARTS):
            raise ConfigError(f"data.part: expected null, {' or '.join(PARTS)}, got '{part}'.")
        self._part = part
        declared = (reserved_part(self.facts.get("test"), f"{path}: test"), reserved_part(test, "data.test"))
        self._reserved = [part for part in declared if part is not None]

    @cached_property
    def names(self) -> list[str]:
        """Names of all sequences of the directory."""
        folder = self.root / "sequences"
        return sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []

    @cached_property
    def test_part(self) -> frozenset[str]:
        """Names of the sequences reserved for the final test, of all of the directory; empty where none is declared.

        Raises:
            DataError: a reserved sequence does not exist.
        """
        seed = self.facts.get("seed")
        parts = [part.of(self.names, seed, str(self.root / "dataset.json")) for part in self._reserved]
        return frozenset[str]().union(*parts)

    def record(self, name: str) -> SequenceRecord:
        """A new record of a sequence, which is freed with all that it has decoded."""
        safe_name(name, f"{self.root}: sequence")
        limit = self.train_frames.stop if self.sealed and name in self.test_part else None
        return SequenceRecord(self.root / "sequences" / name, views=self.views, fps=self.fps, limit=limit)

    @cached_property
    def sequences(self) -> list[SequenceRecord]:
        """The object's sequences in the order of their names."""
        folder, found, wanted = self.root / "sequences", self.names, self._chosen
        if self._part is not None:
            found = [name for name in found if (name in self.test_part) == (self._part == "test")]
        if isinstance(wanted, int):
            chosen = found[:wanted] if 0 < wanted <= len(found) else []
        else:
            chosen = found if wanted is None else list(wanted)
        if not chosen or not set(chosen) <= set(found):
            asked = "of any name" if wanted is None else wanted
            of = f" of the {self._part} part" if self._part else ""
            raise DataError(f"{folder}: sequences {asked} asked for, it has {len(found)}{of}: {found}.")
        records = [self.record(name) for name in chosen]
        for record in records:
            if record.count < self.train_frames.stop:
                raise DataError(
                    f"{record.root}: has {record.count} frames, dataset.json trains on {self.train_frames}. "
                    "Complete the sequence or leave it out."
                )
        counts = {r.name: 0 if r.hands is None else r.hands.centres.shape[1] for r in records}
        if len(set(counts.values())) > 1:
            raise DataError(f"{folder}: hands.npz must be of the same hands in every sequence, got {counts} hands.")
        return records

    @cached_property
    def rest_points(self) -> Float[Tensor, "P 3"] | None:
        """Rest positions of the points whose true motion is known [scene units]; None where unknown."""
        points, mesh = self.root / "rest_points.npz", self.root / "rest_mesh.npz"
        if points.is_file():
            return torch.from_numpy(read_array(points, "points")).float()
        if mesh.is_file():
            return torch.from_numpy(read_array(mesh, "vertices")[read_array(mesh, "gt_ids")]).float()
        return None

    def ground_truth(self, sequence: SequenceRecord) -> GroundTruth | None:
        """True motion of a sequence of this object, or None where it is unknown."""
        return sequence.ground_truth(self.rest_points)

    def stills(self) -> Stills:
        """Posed images of the rest state, split into those for reconstruction and those for its evaluation."""
        return read_stills(self.root / "static" / "transforms.json")

    @property
    def diagonal(self) -> float | None:
        """Bounding-box diagonal of the true object [scene units], where ``dataset.json`` states it."""
        value = self.facts.get("object_diagonal")
        return float(value) if isinstance(value, (int, float)) and value > 0 else None

    def scene(self) -> GaussianScene:
        """The rest scene with its masks and the configured selections, named after the object.

        Raises:
            DataError: the scene file does not exist.
            SceneError: the scene is unusable or has no pinned kernel.
        """
        if not self.scene_path.is_file():
            raise DataError(
                f"{self.scene_path}: no rest scene. Make one with `gausim reconstruct {self.root}`, "
                "or name one in the data config (scene: path/to/scene.ply)."
            )
        scene = load_scene(self.scene_path, masks=self.masks_path, name=self.name)
        scene = replace(select_masks(scene, self.selections), surroundings=self.surroundings, law=self.law)
        first = self.sequences[0] if (self.root / "sequences").is_dir() else None
        if first is not None and first.holds is not None:
            scene = gripped(scene, *first.holds, self._grip, str(self.root / "dataset.json"))
        return require_pinned(scene)

    def _check_views(self, path: Path) -> None:
        both = set(self.train_views) & set(self.heldout_views)
        unknown = (set(self.train_views) | set(self.heldout_views)) - set(self.views)
        if both or unknown or not self.train_views or len(set(self.views)) != len(self.views):
            raise DataError(
                f"{path}: fields 'train_views' {list(self.train_views)} and 'heldout_views' "
                f"{list(self.heldout_views)} must be disjoint parts of 'views' {list(self.views)}, the first not empty."
            )


def find_objects(root: Path | str) -> list[Path]:
    """Object directories at ``root``: itself if it has a ``dataset.json``, else its children that have one.

    Raises:
        DataError: no ``dataset.json`` was found.
    """
    root = Path(root)
    if (root / "dataset.json").is_file():
        return [root]
    found = sorted(p.parent for p in root.glob("*/dataset.json"))
    if not found:
        above = next((p for p in root.absolute().parents if (p / "dataset.json").is_file()), None)
        if above is not None:
            raise DataError(f"{root}: no data set here; it is a part of the one in {above}. Give that directory.")
        why = "no dataset.json in it or in a folder of it" if root.is_dir() else "there is no such directory"
        raise DataError(
            f"{root}: no data set here ({why}). Make the embedded one with `gausim prepare synthesize`, or point "
            "the data config at yours (data.root=DIR)."
        )
    return found


def select_masks(scene: GaussianScene, selections: Mapping[str, Selection | str]) -> GaussianScene:
    """Replaces masks by selections, e.g. ``{"pinned": "z=0.33"}`` (below that height) or any ``Selection``.

    Raises:
        ConfigError: a mask of this name does not exist.
        SceneError: a selection is malformed or contains no kernel.
    """
    unknown = sorted(set(selections) - set(MASK_NAMES))
    if unknown:
        raise ConfigError(f"data.selections: no such mask {unknown}; expected some of {MASK_NAMES}.")
    return apply_masks(scene, **{k: parse_half_space(s) if isinstance(s, str) else s for k, s in selections.items()})
