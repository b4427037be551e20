"""The LightningDataModule over READY-like object directories."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from gausim.core import ConfigError
from gausim.data.dataset import SampleKey, SequenceIndex, SequenceSample, collate
from gausim.data.objects import ObjectData, find_objects
from gausim.data.sampler import SequenceBatchSampler, Shows
from gausim.ops.selection import Selection


class ReadyDataModule(LightningDataModule):
    """Streams multi-view sequences of one or several objects; the plan sets their number and length.

    Training batches are lists of :class:`SequenceSample` (frames 0..T of the training views only).

    Attributes:
        plan: shows, batch size and predicted frames; set before training batches are asked for.
        sealed: whether unseen frames and the true motion of the test part are refused; set before objects are read.
    """

    def __init__(
        self,
        root: str | Path | Sequence[str | Path | Mapping[str, Any]] | None,
        *,
        scene: str | Path | None = None,
        masks: str | Path | None = None,
        selections: Mapping[str, Selection | str] | None = None,
        plan: Shows | None = None,
        seed: int = 0,
        prefetch: int = 0,
        names: Sequence[str] | None = None,
        sequences: int | Sequence[str] | None = None,
        law: str | None = None,
        part: str | None = None,
        test: Mapping[str, Any] | None = None,
    ) -> None:
        """Stores the settings; files are first read by :attr:`objects` or :meth:`setup`.

        Args:
            root: an object directory, a folder of such, or a list of either; an entry of the list may be a mapping
                with ``root`` and separate ``scene``, ``masks``, ``selections``, ``law`` and ``test``.
            scene: PLY of the rest scene of a single object; ``scene.ply`` in its directory when None.
            masks: npz of its masks; beside the PLY when None.
            selections: replacements of its masks, see :func:`gausim.data.objects.select_masks`.
            plan: the resolved training plan, or its part that data follow.
            seed: seed of the training order.
            prefetch: number of batches that a process of its own reads ahead; 0 reads each when it is asked for.
            names: names of the objects to use; all when None.
            sequences: number of sequences per object to use, or their names; all when None.
            law: of large deformations, ``solid`` or ``springs``; None: that of ``dataset.json``, else ``solid``.
            part: use only the sequences of the ``development`` or the ``test`` part; those of both when None.
            test: the test part of the objects (:class:`gausim.data.objects.ReservedPart`), in addition to what their
                ``dataset.json`` declares.
        """
        super().__init__()
        self._root, self._names, self._sequences = root, names, sequences
        self._options: dict[str, Any] = {
            "scene": scene, "masks": masks, "selections": selections, "law": law, "test": test,
        }  # fmt: skip
        self._part = part
        self.sealed = True
        self.plan, self._seed, self._prefetch = plan, seed, prefetch
        self._sampler: SequenceBatchSampler | None = None

    @cached_property
    def objects(self) -> list[ObjectData]:
        """The objects; their index is the ``scene_id`` of samples.

        Raises:
            ConfigError: a root is not set, or an object of ``names`` does not exist.
            DataError: a root contains no data set.
        """
        sources = [self._root] if self._root is None or isinstance(self._root, (str, Path)) else self._root
        found = [item for source in sources for item in self._open(source)]
        have = [item.name for item in found]
        if not found or len(set(have)) != len(have):
            raise ConfigError(f"data.root: expected at least one object, each name once, got {have}.")
        absent = [name for name in self._names or () if name not in have]
        if absent or self._names == []:
            raise ConfigError(f"data.names: {list(self._names or ())} asked for, the roots hold {have}.")
        return [item for item in found if self._names is None or item.name in self._names]

    @cached_property
    def index(self) -> SequenceIndex:
        """All sequences of all objects, numbered; the number is the ``sequence_id`` of samples."""
        return SequenceIndex(self.objects)

    def setup(self, stage: str | None = None) -> None:
        """Opens the objects and determines the training order, before a checkpoint's position is loaded."""
        if stage in (None, "fit"):
            if self.plan is None:
                raise ConfigError("data: expected a resolved training plan (gausim.training.plan), got none.")
            rank, ranks = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
            self._sampler = SequenceBatchSampler(
                len(self.index), plan=self.plan, seed=self._seed, rank=rank, world_size=ranks
            )

    def introduction(self) -> list[str]:
        """A line per object, and one about what of it is not trained on."""
        lines, first = [], (self.plan.t_max or 0) + 1 if self.plan else 0
        for item in self.objects:
            cameras = item.sequences[0].cameras
            lines.append(
                f"{item.name}: {len(item.sequences)} sequences, {len(item.train_views)} views of "
                f"{cameras.width}x{cameras.height}, {item.fps:g} fps, {item.law}, {item.root}"
            )
            if 0 < first < item.train_frames.stop:
                lines.append(
                    f"{item.name}: frames {first}..{item.train_frames.stop - 1} are seen, but not trained on "
                    f"(plan.t_max={first - 1})"
                )
            sealed = [record.name for record in item.sequences if record.limit is not None]
            if sealed:
                lines.append(
                    f"{item.name}: {', '.join(sealed)} are of the test part: only images of frames 0.."
                    f"{item.train_frames.stop - 1} are read, and their motion is not checked"
                )
        return lines

    def training_sample(self, sequence: int, steps: int) -> SequenceSample:
        """Frames 0..``steps`` of a sequence in the training views."""
        return self.index[SampleKey(sequence, steps)]

    def train_dataloader(self) -> DataLoader:
        """Batches of training samples.

        Image files are decoded once and cached, packed frames are read directly: a worker pays only where a batch is
        large and a step short.

        Raises:
            ConfigError: ``prefetch`` is negative.
        """
        if self._prefetch < 0:
            raise ConfigError(f"data.prefetch: expected 0 or more batches read ahead, got {self._prefetch}.")
        ahead = self._prefetch > 0
        # The loader draws one number per epoch; from the global generator, a resumed run would draw a different count.
        return DataLoader(
            self.index, batch_sampler=self._ready_sampler(), collate_fn=collate, generator=torch.Generator(),
            num_workers=int(ahead), prefetch_factor=self._prefetch or None, persistent_workers=ahead,
        )  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        """Epoch and position in the training order, for an exact resume."""
        if self._sampler is None:
            return {}
        state = self._sampler.state_dict()
        if self.trainer is not None:
            # Batches trained on, without those that the loader has read ahead.
            state["position"] = self.trainer.fit_loop.epoch_loop.batch_progress.current.ready
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues the training order at the position of a checkpoint."""
        if state_dict:
            self._ready_sampler().load_state_dict(state_dict)

    def _ready_sampler(self) -> SequenceBatchSampler:
        if self._sampler is None:
            self.setup("fit")
        assert self._sampler is not None
        return self._sampler

    def _open(self, source: str | Path | Mapping[str, Any] | None) -> list[ObjectData]:
        own = dict(source) if isinstance(source, Mapping) else {"root": source}
        root, options = own.pop("root", None), {**self._options, **own}
        if root is None:
            raise ConfigError(
                "data.root: no directory of a data set is given. Set data.root=PATH on the command line, or the "
                "environment variable that the data config names."
            )
        if set(options) - set(self._options):
            raise ConfigError(f"data.root: unknown key in {own}; expected root and {sorted(self._options)}.")
        roots = find_objects(root)
        if len(roots) > 1 and any(options[key] is not None for key in ("scene", "masks")):
            raise ConfigError(f"data.root: 'scene' and 'masks' are of one object, but {root} holds {len(roots)}.")
        return [ObjectData(r, sequences=self._sequences, part=self._part, sealed=self.sealed, **options) for r in roots]
