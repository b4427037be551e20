"""Supervision by motion tracks: kernel motion fitted to the videos before training on it.

A rollout can only show motion that its dynamics allow, so the loss gradient of its images mixes two questions: where
the object is in this frame, and which forces bring it there. Tracking answers the first question alone. Each frame's
coordinates in the model's smooth motions are those whose rendering agrees best with the frame,

    q_t = argmin_q L(draw(X + sum_m q_m phi_m), frame_t) + prior |q|^2,    q_0 = 0,

found by Adam from an extrapolation of the two frames before; no dynamics are assumed. The motions phi are scaled to
equal elastic energy, so coordinates that no camera determines stay at rest. Rollouts are then compared with the tracked
kernels in 3D: every part of the object has the same weight, with little texture or much, and nothing is rendered.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import ConfigError, SmoothMotions
from gausim.data.dataset import SequenceSample
from gausim.data.images import composite
from gausim.data.records import GroundTruth
from gausim.ops.deformation import polar_rotation
from gausim.render.draw import draw
from gausim.training.supervision.comparison import channels
from gausim.training.supervision.images import Appearances, Sources
from gausim.training.supervision.points import PointSupervision

# Adam's decay rates of the moments: short memories, because a frame takes some tens of iterations.
BETAS = (0.8, 0.95)


class MotionTracker:
    """Fits the coordinates of a scene's smooth motions frame by frame."""

    def __init__(
        self,
        sources: Sources,
        *,
        iterations: int = 40,
        rate: float = 1.0,
        momentum: float = 0.7,
        prior: float = 1.0,
    ) -> None:
        """``conf/supervision/tracks.yaml`` explains the settings; the rate falls linearly to zero."""
        if iterations < 1 or rate <= 0:
            raise ConfigError(
                f"supervision: expected iterations >= 1 and rate > 0, got iterations={iterations}, rate={rate}."
            )
        self._sources, self._iterations, self._rate = sources, iterations, rate
        self._momentum, self._prior = momentum, prior
        self._motions: dict[int, SmoothMotions] = {}
        self._appearances = Appearances(sources.scenes)

    def motions(self, scene_id: int) -> SmoothMotions:
        """The smooth motions of a scene; raises ConfigError where the model has none."""
        if scene_id not in self._motions:
            found = self._sources.motions(scene_id)
            if found is None:
                raise ConfigError(
                    "supervision: motion is tracked in the smooth motions that a model's template carries, and this "
                    "model has none. Use supervision=images with it."
                )
            self._motions[scene_id] = found
        return self._motions[scene_id]

    def extend(self, known: Float[Tensor, "F M"] | None, sample: SequenceSample) -> Float[Tensor, "T M"]:
        """Coordinates of all frames of a sample; those of its first F frames are ``known``.

        A frame's coordinates depend on the earlier frames only, so the result is independent of the number of calls in
        which a sequence is tracked.
        """
        motions = self.motions(sample.scene_id)
        if known is None:
            known = motions.kernels.new_zeros(1, motions.count)
        frames = list(known.to(sample.frames.device))
        while len(frames) <= sample.steps:
            guess = frames[-1]
            if len(frames) > 1:
                guess = guess + self._momentum * (frames[-1] - frames[-2])
            frames.append(self._find(sample, len(frames), guess))
        return torch.stack(frames)

    def _find(self, sample: SequenceSample, frame: int, guess: Float[Tensor, " M"]) -> Float[Tensor, " M"]:
        loss, renderer = self._sources.loss, self._sources.renderer
        motions, appearance = self.motions(sample.scene_id).to(guess), self._appearances.of(sample.scene_id, guess)
        rest = self._sources.scenes[sample.scene_id].means.to(guess)
        target = channels(*composite(sample.frames[frame : frame + 1]), loss)
        place = guess.clone().requires_grad_()
        optimizer = torch.optim.Adam([place], lr=self._rate, betas=BETAS)
        for iteration in range(self._iterations):
            optimizer.param_groups[0]["lr"] = self._rate * (1 - iteration / self._iterations)
            deformation_gradients = motions.deformations(place[None])
            rotations = polar_rotation(deformation_gradients.detach())
            state = rest + motions.displacements(place[None]), deformation_gradients, rotations
            drawn = draw(renderer, appearance, *state, motions.unit_of_kernel, sample.cameras)
            optimizer.zero_grad()
            error = loss(channels(drawn.rgb, drawn.alpha, loss), target).sum()
            (error + self._prior * place.square().sum()).backward()
            optimizer.step()
        return place.detach()


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

    def motion(self, sample: SequenceSample) -> GroundTruth:
        """Tracked positions of the simulated kernels."""
        known = self._coordinates.get(sample.sequence_id)
        if known is None or len(known) <= sample.steps:
            with torch.enable_grad():
                self._coordinates[sample.sequence_id] = self.tracker.extend(known, sample)
        scene, motions = self._sources.scenes[sample.scene_id], self.tracker.motions(sample.scene_id)
        free = scene.simulated & ~scene.pinned
        moved = motions.displacements(self._coordinates[sample.sequence_id].to(motions.kernels))
        return GroundTruth(scene.means[free], scene.means[free] + moved[:, free])

    def state_dict(self) -> dict[int, Tensor]:
        """Coordinates by sequence, for a resumed run."""
        return dict(self._coordinates)

    def load_state_dict(self, state: dict[int, Tensor]) -> None:
        """Restores the coordinates."""
        self._coordinates = dict(state)


def tracks_or_images(sources: Sources, **settings: Any) -> TrackSupervision | None:
    """Supervision by motion tracks where the model has smooth motions; else None, which selects the images."""
    if any(sources.motions(scene_id) is None for scene_id in range(len(sources.scenes))):
        return None
    return TrackSupervision(sources, **settings)
