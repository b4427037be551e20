"""Samples for training: frames 0..T of one sequence in 8 bits, with their cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import UInt8
from torch import Tensor
from torch.utils.data import Dataset

from gausim.core import Cameras, ConfigError, DataError
from gausim.data.objects import ObjectData
from gausim.data.records import GroundTruth, SequenceRecord


class SampleKey(NamedTuple):
    """Key by which the batch sampler requests a training sample."""

    sequence: int  # global sequence id
    steps: int  # predicted steps T; the sample has frames 0..T


@dataclass(frozen=True)
class SampleFacts:
    """Description of a sample, exchanged between ranks."""

    scene_id: int  # index of the object
    object_name: str  # its name
    sequence_id: int  # running index of the sequence over all objects
    sequence_name: str  # its name within the object
    steps: int  # predicted steps T


@dataclass(frozen=True, eq=False)
class SequenceSample:
    """Frames 0..T of one sequence."""

    scene_id: int  # index of the object
    object_name: str  # its name
    sequence_id: int  # running index of the sequence over all objects
    sequence_name: str  # its name within the object
    frames: UInt8[Tensor, "F V H W 4"]  # straight-alpha RGBA of T + 1 frames in V views
    cameras: Cameras  # the V cameras
    fps: float  # frames per second

    @property
    def steps(self) -> int:
        """Predicted steps T: frames after the first."""
        return self.frames.shape[0] - 1

    @property
    def facts(self) -> SampleFacts:
        """Description of the sample without its images."""
        return SampleFacts(self.scene_id, self.object_name, self.sequence_id, self.sequence_name, self.steps)

    def to(self, device: torch.device | str) -> "SequenceSample":
        """The same sample on another device (Lightning moves batches through this)."""
        return replace(self, frames=self.frames.to(device, non_blocking=True), cameras=self.cameras.to(device))


class SequenceIndex(Dataset):
    """The sequences of several objects, numbered consecutively from 0 over all objects.

    As a data set for training it returns only frames 0..T of the training views.
    """

    def __init__(self, objects: Sequence[ObjectData]) -> None:
        """Lists all sequences of these objects (reads their transforms, but no image)."""
        self.objects = list(objects)
        self.entries: list[tuple[int, SequenceRecord]] = [
            (scene_id, record) for scene_id, item in enumerate(self.objects) for record in item.sequences
        ]

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, key: SampleKey) -> SequenceSample:
        """Frames 0..steps of one sequence in the training views.

        Raises:
            DataError: the steps exceed the training frames.
        """
        sequence, steps = key
        item = self.objects[self.entries[sequence][0]]
        if not 1 <= steps < len(item.train_frames):
            raise DataError(
                f"{item.name}: {steps} predicted steps asked for, the training frames "
                f"{item.train_frames.start}..{item.train_frames.stop - 1} allow 1..{len(item.train_frames) - 1}. "
                "Lower plan.t_max."
            )
        return self.sample(sequence, range(steps + 1), item.train_views)

    def sample(self, sequence: int, frames: range, views: Sequence[str]) -> SequenceSample:
        """The sample of these frames and views of a sequence."""
        scene_id, record = self.entries[sequence]
        return SequenceSample(
            scene_id=scene_id,
            object_name=self.objects[scene_id].name,
            sequence_id=sequence,
            sequence_name=record.name,
            frames=record.frames(frames, views),
            cameras=record.cameras_of(views),
            fps=record.fps,
        )

    def ground_truth(self, sequence: int) -> GroundTruth | None:
        """True motion of a sequence, or None where it is unknown."""
        scene_id, record = self.entries[sequence]
        return self.objects[scene_id].ground_truth(record)


def collate(samples: list[SequenceSample]) -> list[SequenceSample]:
    """Returns the list itself: scenes differ in kernels, views and image size and cannot be stacked.

    Raises:
        ConfigError: samples of the batch differ in length (all rollouts of a batch advance together).
    """
    if len({sample.steps for sample in samples}) > 1:
        raise ConfigError(f"a batch needs one number of steps, got {[s.steps for s in samples]}.")
    return samples
