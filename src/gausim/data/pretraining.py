"""The LightningDataModule over a corpus of bodies with known motion and material (:mod:`gausim.data.corpus`)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Cameras, ConfigError, GaussianScene, SimState
from gausim.data.corpus import BodyRecord, Corpus, CorpusBody
from gausim.data.datamodule import ReadyDataModule
from gausim.data.dataset import SampleKey, SequenceIndex, SequenceSample
from gausim.data.records import GroundTruth
from gausim.data.sampler import Shows

# Bodies of which the motion stays in memory.
BODIES_IN_MEMORY = 128
NO_CAMERAS = Cameras(torch.zeros(0, 4, 4), torch.zeros(0, 3, 3), 1, 1, ())


@dataclass(frozen=True)
class BodySequence:
    """One motion of a body; its first frame is the state before frame 0."""

    name: str
    number: int  # within the body
    count: int  # frames from frame 0 on


class BodyData:
    """A body of a corpus, with the parts of :class:`gausim.data.objects.ObjectData` that true points allow.

    Attributes:
        name: the body's name.
        fps: frames per second.
        train_frames: frames that count as seen.
        train_views: no view.
        sequences: its motions.
    """

    def __init__(self, read: Callable[[], CorpusBody], record: BodyRecord, seen: int) -> None:
        """``read()`` returns the body of a record."""
        self._read, self.name, self.fps = read, record.name, record.fps
        self.train_frames, self.train_views = range(seen), ()
        self.sequences = [BodySequence(f"seq_{i:03d}", i, record.frames - 1) for i in range(record.sequences)]

    @property
    def body(self) -> CorpusBody:
        """The body as the corpus has it."""
        return self._read()

    @property
    def rest_points(self) -> Float[Tensor, "K 3"]:
        """Rest positions of the kernels [scene units]."""
        return self.body.rest

    def ground_truth(self, sequence: BodySequence) -> GroundTruth:
        """True motion of the kernels, frame 0 first."""
        body = self.body
        return GroundTruth(body.rest, body.positions[sequence.number, 1:])

    def state(self, sequence: BodySequence, frame: int) -> SimState:
        """True positions at ``frame`` and one frame earlier."""
        positions = self.body.positions[sequence.number]
        return SimState(positions[frame + 1], positions[frame])

    def scene(self) -> GaussianScene:
        """The body as grey kernels of equal size in all directions."""
        body, count = self.body, len(self.body.rest)
        return GaussianScene.create(
            means=body.rest,
            log_scales=body.scale.log()[:, None].expand(-1, 3).clone(),
            quats=torch.eye(4)[:1].expand(count, -1).clone(),
            opacity_logits=torch.full((count,), 3.0),
            sh=torch.zeros(count, 1, 3),
            pinned=body.pinned,
            name=self.name,
        )


class CorpusIndex(SequenceIndex):
    """The motions of several bodies, numbered consecutively; a sample has no image.

    Of the true motion, training is given the first ``shown`` frames; all of them when None.
    """

    def __init__(self, objects: Sequence[Any], shown: int | None = None) -> None:
        """Lists the motions of these bodies."""
        super().__init__(objects)
        self._shown = shown

    def ground_truth(self, sequence: int) -> GroundTruth:
        """The frames of a motion that training may use."""
        scene_id, record = self.entries[sequence]
        truth = cast(BodyData, self.objects[scene_id]).ground_truth(cast(Any, record))
        return GroundTruth(truth.rest, truth.positions[: self._shown])

    def __getitem__(self, key: SampleKey) -> SequenceSample:
        """The sample of ``steps`` frames after frame ``start``, without views."""
        scene_id, record = self.entries[key.sequence]
        item = self.objects[scene_id]
        frames = torch.zeros(key.steps + 1, 0, 0, 0, 4, dtype=torch.uint8)
        return SequenceSample(
            scene_id, item.name, key.sequence, record.name, frames, NO_CAMERAS, item.fps, start=key.start
        )

    def state(self, sequence: int, frame: int) -> SimState:
        """True positions at a frame of a sequence and one frame earlier."""
        scene_id, record = self.entries[sequence]
        return cast(BodyData, self.objects[scene_id]).state(cast(Any, record), frame)


class CorpusDataModule(ReadyDataModule):
    """Bodies of a corpus for pretraining, or the ones held out of it for fits of a new body.

    The last ``held_out`` bodies of the corpus are never trained on with ``part=train``. Then training samples start at
    any frame, the material of all bodies is known, and the motion watch measures predictions of the bodies held out.
    With ``part=held_out`` these bodies are the objects: their material is unknown, and only the first ``seen`` frames
    are used; samples start at any of them.

    Attributes:
        watched: indices of the objects whose motion is measured during training.
        trainable: number of bodies of the corpus that are not held out; set when the objects are first read.
        seen: frames that count as seen.
        knows_material: whether the material is given.
    """

    has_videos = False

    def __init__(
        self,
        root: str | Path | None,
        *,
        part: str = "train",
        bodies: int | None = None,
        held_out: int = 12,
        seen: int = 16,
        plan: Shows | None = None,
        seed: int = 0,
        prefetch: int = 0,
    ) -> None:
        """Stores the settings; the corpus is first read by :attr:`objects`.

        Args:
            root: directory of the corpus (`gausim prepare corpus`).
            part: ``train`` or ``held_out``.
            bodies: number of bodies to train on; all but the ones held out when None.
            held_out: number of bodies held out.
            seen: frames that count as seen in the figures, and the ones used with ``part=held_out``.
            plan: the resolved training plan, or its part that data follow.
            seed: seed of the training order.
            prefetch: number of batches that a process of its own reads ahead.
        """
        super().__init__(root, plan=plan, seed=seed, prefetch=prefetch)
        if part not in ("train", "held_out") or held_out < 1:
            raise ConfigError(
                f"data.part, data.held_out: expected train or held_out and a number >= 1, got {part}, {held_out}."
            )
        self._bodies, self._held_out, self.seen = bodies, held_out, seen
        self.knows_material = part == "train"

    @cached_property
    def objects(self) -> list[Any]:
        """The bodies; their index is the ``scene_id`` of samples. Those held out come last."""
        if self._root is None:
            raise ConfigError(
                "data.root: no corpus is given. Make one with `gausim prepare corpus`, set data.root=DIR."
            )
        corpus = Corpus(Path(str(self._root)))
        self.trainable = first = len(corpus) - self._held_out
        wanted = first if self._bodies is None else self._bodies
        if not 1 <= wanted <= first:
            raise ConfigError(
                f"data.bodies: {wanted} bodies to train on and {self._held_out} held out asked for, the corpus "
                f"{self._root} has {len(corpus)}."
            )
        chosen = [*(range(wanted) if self.knows_material else ()), *range(first, len(corpus))]
        read = lru_cache(BODIES_IN_MEMORY)(corpus.body)
        return [BodyData(partial(read, i), corpus.manifest.bodies[i], self.seen) for i in chosen]

    @cached_property
    def index(self) -> CorpusIndex:
        """All sequences of all bodies, numbered."""
        return CorpusIndex(self.objects, None if self.knows_material else self.seen)

    @property
    def watched(self) -> range:
        """The bodies held out."""
        return range(len(self.objects) - self._held_out, len(self.objects))

    def trained(self) -> tuple[int, list[int] | None]:
        """The number of sequences to train on, and the numbers of their frames at which samples may start and end."""
        if not self.knows_material:
            return len(self.index), [self.seen] * len(self.index)
        frames = [record.count for scene_id, record in self.index.entries if scene_id not in self.watched]
        return len(frames), frames

    def introduction(self) -> list[str]:
        """The corpus in one line."""
        count, (sequences, _) = len(self.objects) - self._held_out, self.trained()
        known = f"{count} bodies of known material" if self.knows_material else "bodies of unknown material"
        return [f"{self._root}: {known}, {sequences} sequences; {self._held_out} bodies held out"]
