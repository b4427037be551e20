"""Supervision by motion tracks: kernel motion fitted to the videos, frame by frame, without any dynamics.

A rollout can only show motion that its dynamics allow, so the loss gradient of its images mixes two questions: where
the object is in this frame, and which forces bring it there. Tracking answers the first question alone. Each frame's
coordinates in the model's smooth motions are those whose rendering agrees best with the frame,

    q_t = argmin_q |draw(X + sum_m q_m phi_m) - frame_t|^2 + prior |q|^2,    q_0 = 0,

(for a body in hands relative to its reference, :mod:`gausim.models.reference.held`,)
found by Levenberg and Marquardt's method on images of falling blur, from an extrapolation of the two frames before; no
dynamics are assumed. Its matrix J^T J is that of the rest state, by finite differences. The motions phi are scaled to
about equal elastic energy, so coordinates that no camera determines stay at rest.

Rollouts are compared with the tracked kernels in 3D: every part of the object has the same weight, with little texture
or much, and nothing is rendered.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from gausim.core import Cameras, ConfigError, Frame, SmoothMotions
from gausim.data.dataset import SequenceSample
from gausim.data.images import composite
from gausim.data.records import GroundTruth
from gausim.models.reference.reference import Carried
from gausim.ops.deformation import polar_rotation
from gausim.render.draw import draw
from gausim.training.supervision.comparison import channels
from gausim.training.supervision.images import Appearances, Sources, ViewKeys
from gausim.training.supervision.points import PointSupervision

# Displacements of the finite differences that give the curvature [diagonals]; in smaller ones the renderer's cut-off of
# faint pixels shows.
DIFFERENCE = 0.01
# Part of the error that a step has to take away for another one to follow on the same images.
LEAST_GAIN = 0.03
TINY = 1e-12
# Levenberg and Marquardt's damping, in mean eigenvalues of the curvature: its start, and factors after a step that is
# accepted and after one that is not.
DAMPING, LESS, MORE = 0.1, 1 / 3, 4.0
# Fewest pixels along an image's side.
LEAST_SIDE = 32


@dataclass(frozen=True, eq=False)
class Curvature:
    """Eigenvalues and vectors of J^T J of the images in a scene's coordinates, at rest."""

    values: Float[Tensor, " M"]
    vectors: Float[Tensor, "M M"]

    def step(self, slope: Float[Tensor, " M"], damping: float) -> Float[Tensor, " M"]:
        """(J^T J + damping I)^-1 slope."""
        return self.vectors @ ((slope @ self.vectors) / (self.values + damping))


class MotionTracker:
    """Fits the coordinates of a scene's smooth motions frame by frame."""

    def __init__(
        self,
        sources: Sources,
        *,
        iterations: int = 6,
        pyramid: Sequence[int] = (8, 4, 2, 1),
        momentum: float = 0.7,
        prior: float = 0.01,
    ) -> None:
        """``conf/supervision/tracks.yaml`` explains the settings."""
        if iterations < 1 or not pyramid or min(pyramid) < 1 or prior < 0:
            raise ConfigError(
                "supervision: expected iterations >= 1, pyramid of at least one factor >= 1 and prior >= 0, got "
                f"iterations={iterations}, pyramid={list(pyramid)}, prior={prior}."
            )
        self._sources, self._iterations, self._pyramid = sources, iterations, tuple(pyramid)
        self._momentum, self._prior = momentum, prior
        self._motions: dict[int, SmoothMotions] = {}
        self._appearances = Appearances(sources.scenes)
        self._keys, self._known = ViewKeys(), dict[Hashable, dict[int, Curvature]]()

    def motions(self, scene_id: int) -> SmoothMotions:
        """The smooth motions of a scene."""
        if scene_id not in self._motions:
            self._motions[scene_id] = self._sources.motions(scene_id)
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
        references = self._sources.references(sample.sequence_id, sample.steps)
        while len(frames) <= sample.steps:
            guess = frames[-1]
            if len(frames) > 1:
                guess = guess + self._momentum * (frames[-1] - frames[-2])
            carried = None if references is None else references[len(frames) - 1][0]
            frames.append(self._find(sample, len(frames), guess, carried))
        return torch.stack(frames)

    def _find(
        self, sample: SequenceSample, frame: int, guess: Float[Tensor, " M"], carried: Carried | None
    ) -> Float[Tensor, " M"]:
        target = channels(*composite(sample.frames[frame : frame + 1]), self._sources.loss)
        place = guess
        for factor in self._factors(sample.cameras):
            place = self._descend(sample, factor, _shrunk(target, factor), place, carried)
        return place

    def _factors(self, cameras: Cameras) -> list[int]:
        """The factors by which images of a size are reduced."""
        side = min(cameras.width, cameras.height)
        return [f for f in self._pyramid if f == self._pyramid[-1] or side >= LEAST_SIDE * f]

    def _descend(
        self,
        sample: SequenceSample,
        factor: int,
        target: Float[Tensor, "1 V H W C"],
        place: Float[Tensor, " M"],
        carried: Carried | None,
    ) -> Float[Tensor, " M"]:
        """Steps of Levenberg and Marquardt's method on images reduced by a factor."""
        curvature = self._curvatures(sample)[factor]
        unit = float(curvature.values.mean())
        prior, damping = self._prior * unit, DAMPING

        def compare(place: Tensor) -> tuple[Tensor, Tensor]:
            """The error as part of a graph, and the leaf of that."""
            place = place.detach().requires_grad_()
            off = _shrunk(self._drawn(sample, place[None], carried), factor) - target
            return 0.5 * (off.square().sum() + prior * place.square().sum()), place

        error, leaf = compare(place)
        (slope,) = torch.autograd.grad(error, leaf)
        for iteration in range(self._iterations):
            found, leaf = compare(place - curvature.step(slope, prior + damping * unit))
            gain = float(1 - found.detach() / error.detach())
            if gain <= 0:
                damping *= MORE
                continue
            place, error, damping = leaf.detach(), found, damping * LESS
            if gain < LEAST_GAIN or iteration == self._iterations - 1:
                break
            (slope,) = torch.autograd.grad(error, leaf)  # only for a step that follows
        return place.detach()

    def _drawn(
        self, sample: SequenceSample, places: Float[Tensor, "B M"], carried: Carried | None = None
    ) -> Float[Tensor, "B V H W C"]:
        """Images of the scene at some coordinates; B is 1 where the reference moves."""
        motions, appearance = self.motions(sample.scene_id).to(places), self._appearances.of(sample.scene_id, places)
        rest = self._sources.scenes[sample.scene_id].means.to(places)
        deformation_gradients = motions.deformations(places)
        rotations = polar_rotation(deformation_gradients.detach())
        positions = rest + motions.displacements(places)
        if carried is not None:
            frame = carried.place(Frame(positions[0], deformation_gradients[0], rotations[0]))
            positions, rotations = frame.positions[None], frame.rotations[None]
            deformation_gradients = frame.deformation_gradients[None]
        drawn = draw(
            self._sources.renderer, appearance, positions, deformation_gradients, rotations, motions.unit_of_kernel,
            sample.cameras,
        )  # fmt: skip
        return channels(drawn.rgb, drawn.alpha, self._sources.loss)

    @torch.no_grad()
    def _curvatures(self, sample: SequenceSample) -> dict[int, Curvature]:
        """Curvature of a scene's images in the sample's cameras, reduced by every factor; computed once."""
        key = self._keys.of(sample)
        if key not in self._known:
            motions, factors = self.motions(sample.scene_id), self._factors(sample.cameras)
            sizes = (
                DIFFERENCE
                * self._sources.scenes[sample.scene_id].diagonal
                / motions.kernels.norm(dim=1).amax(0).clamp_min(TINY)
            )
            sums = torch.zeros(len(factors), motions.count, motions.count, device=sample.frames.device)
            for view in range(len(sample.cameras.names)):  # one after another, for less memory
                own = replace(sample, cameras=sample.cameras.select([view]))
                slopes = self._slopes(own, sizes.to(sums))
                for number, factor in enumerate(factors):
                    small = _shrunk(slopes, factor).flatten(1)
                    sums[number] += small @ small.mT
            values, vectors = torch.linalg.eigh(sums)
            self._known[key] = {
                factor: Curvature(*own) for factor, *own in zip(factors, values.clamp_min(0), vectors, strict=True)
            }
        return self._known[key]

    def _slopes(self, sample: SequenceSample, sizes: Float[Tensor, " M"]) -> Float[Tensor, "M V H W C"]:
        """Derivatives of the images at rest with respect to the coordinates, by central differences."""
        ends = [torch.cat([self._drawn(sample, row[None]) for row in torch.diag(sign * sizes)]) for sign in (1, -1)]
        return (ends[0] - ends[1]) / (2 * sizes.view(-1, 1, 1, 1, 1))


class TrackSupervision(PointSupervision):
    """Supervision by motion tracks: compares predicted kernels with their tracked positions.

    A frame is tracked when a sample first contains it, so frames that the curriculum does not show are never read.
    """

    def __init__(self, sources: Sources, *, energy_weight: float = 0.3, **tracking: Any) -> None:
        """``energy_weight`` is that of :class:`PointSupervision`, ``tracking`` are arguments of the tracker."""
        super().__init__(sources, energy_weight=energy_weight)
        self.tracker = MotionTracker(sources, **tracking)
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
            positions[frame] = carried.place(Frame(positions[frame], still, still)).positions
        return GroundTruth(scene.means[free], positions[:, free])

    def state_dict(self) -> dict[int, Tensor]:
        """Coordinates by sequence, for a resumed run."""
        return dict(self._coordinates)

    def load_state_dict(self, state: dict[int, Tensor]) -> None:
        """Restores the coordinates."""
        self._coordinates = dict(state)


def _shrunk(images: Float[Tensor, "B V H W C"], factor: int) -> Float[Tensor, "B V h w C"]:
    """Images reduced by the mean over squares of ``factor`` pixels."""
    if factor == 1:
        return images
    small = F.avg_pool2d(images.flatten(0, 1).movedim(-1, 1), factor)
    return small.movedim(1, -1).unflatten(0, images.shape[:2])
