"""Supervision by motion tracks: rollouts are compared with the tracked kernels in 3D.

Every part of the object has the same weight, with little texture or much, and nothing is rendered.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.data.dataset import SequenceSample
from gausim.data.records import GroundTruth
from gausim.models.reference.placed import Placed
from gausim.training.supervision.images import Sources
from gausim.training.supervision.motion_tracker import MotionTracker
from gausim.training.supervision.points import PointSupervision


class TrackSupervision(PointSupervision):
    """Supervision by motion tracks: compares predicted kernels with their tracked positions.

    A frame is tracked when a sample first contains it, so frames that the curriculum does not show are never read.
    """

    def __init__(self, sources: Sources, *, energy_weight: float = 0.3, **tracking: Any) -> None:
        """``energy_weight`` is that of :class:`PointSupervision`, ``tracking`` are arguments of the tracker."""
        super().__init__(sources, energy_weight=energy_weight)
        self.tracker = MotionTracker(sources, **tracking)
        for scene_id in range(len(sources.scenes)):
            self.tracker.motions(scene_id)
        self._sources = sources
        self._coordinates: dict[int, Tensor] = {}

    def displacements(self, sample: SequenceSample) -> Float[Tensor, "F K 3"]:
        """Tracked displacements of all kernels from rest, relative to the reference, frame 0 first [scene units]."""
        known = self._coordinates.get(sample.sequence_id)
        if known is None or len(known) <= sample.steps:
            with torch.enable_grad():
                self._coordinates[sample.sequence_id] = self.tracker.extend(known, sample)
        motions = self.tracker.motions(sample.scene_id)
        return motions.displacements(self._coordinates[sample.sequence_id].to(motions.kernels))

    def motion(self, sample: SequenceSample) -> GroundTruth:
        """Tracked positions of the simulated kernels."""
        scene = self._sources.scenes[sample.scene_id]
        positions, free = scene.means + self.displacements(sample), scene.simulated & ~scene.pinned
        like = self.tracker.motions(sample.scene_id).displacement_gradients[..., 0]
        still = torch.eye(3).to(positions).expand_as(like)
        for frame, (carried, _) in enumerate(self._sources.references(sample.sequence_id, len(positions) - 1) or (), 1):
            positions[frame] = carried.place(Placed(positions[frame], still, still)).positions
        return GroundTruth(scene.means[free], positions[:, free])

    def state_dict(self) -> dict[int, Tensor]:
        """Coordinates by sequence, for a resumed run."""
        return dict(self._coordinates)

    def load_state_dict(self, state: dict[int, Tensor]) -> None:
        """Restores the coordinates."""
        self._coordinates = dict(state)
