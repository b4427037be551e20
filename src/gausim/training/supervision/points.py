"""Supervision by the true motion of points instead of images: fast experiments on dynamics."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core import DataError, GaussianScene
from gausim.data.dataset import SequenceSample
from gausim.data.records import GroundTruth
from gausim.training.contracts import SceneBatch
from gausim.training.rollout import States
from gausim.training.supervision.images import Sources, StaticFigures

# Lower bound of the ratio of predicted to true motion energy in the loss: initial states begin at rest.
LEAST_RATIO = 0.05
# Sequences whose true motion stays in memory.
MOST_KNOWN = 256


def attach_points(scene: GaussianScene, points: Float[Tensor, "P 3"]) -> Int[Tensor, " P"]:
    """Nearest simulated kernel of every rest-space point; the point moves with that kernel's unit."""
    candidates = scene.simulated.nonzero()[:, 0]
    return candidates[_nearest(points.to(scene.means), scene.means[candidates])]


class PointSupervision:
    """Supervision by the true positions of points, where a data set has them.

    The loss of a frame is the mean over points of the squared distance, in (per cent of the scene's diagonal)^2.
    Nothing is rendered. Only the sample's frames are compared, the same as with supervision by images.
    """

    def __init__(self, sources: Sources, *, energy_weight: float = 0.0) -> None:
        """Stores the settings; the true motion is read when a sequence is first shown.

        Args:
            sources: the scenes and the reader of the true motion.
            energy_weight: weight of the squared logarithm of predicted over true motion energy. The term is its mean
                over the halves of a stretch, times the rest state's loss. Without it, the least loss of a motion with a
                wrong phase is no motion.
        """
        self._scenes, self._read = sources.scenes, sources.truth
        self._energy_weight = energy_weight
        self._known: dict[int, GroundTruth] = {}
        self._attached: dict[int, Int[Tensor, " P"]] = {}

    def comparison(self, samples: Sequence[SequenceSample], batch: SceneBatch) -> "_PointComparison":
        """Loss function of the predictions of a batch."""
        truths = [self.motion(sample) for sample in samples]
        for sample, truth in zip(samples, truths, strict=True):
            if sample.scene_id not in self._attached:
                self._attached[sample.scene_id] = attach_points(self._scenes[sample.scene_id], truth.rest)
        attached = [self._attached[sample.scene_id].to(batch.rest.device) for sample in samples]
        scales = [self._scale(sample) for sample in samples]
        known = [
            GroundTruth(truth.rest.to(batch.rest), truth.positions.to(batch.rest))
            for sample, truth in zip(samples, truths, strict=True)
        ]
        return _PointComparison(batch, known, attached, scales, self._energy_weight)

    def static(self, sample: SequenceSample, rest: Float[Tensor, "K 3"], first: int) -> StaticFigures:
        """Losses of the rest state on frames ``first`` .. T of a sample."""
        truth = self.motion(sample)
        positions = truth.positions[first : sample.steps + 1]
        motion = _squared(positions.diff(dim=0))
        losses = _squared(positions - truth.rest) * (1 + self._energy_weight * math.log(1 + 1 / LEAST_RATIO) ** 2)
        scale = self._scale(sample)
        return StaticFigures((scale * losses).tolist(), (scale * motion).tolist())

    def _scale(self, sample: SequenceSample) -> float:
        diagonal = self._scenes[sample.scene_id].diagonal
        return (100 / diagonal) ** 2

    def displacements(self, sample: SequenceSample) -> Float[Tensor, "F K 3"]:
        """Displacements of all kernels from rest, each that of its nearest point, frame 0 first [scene units]."""
        truth = self.motion(sample)
        moved = truth.positions[: sample.steps + 1] - truth.rest
        return moved[:, _nearest(self._scenes[sample.scene_id].means.to(truth.rest), truth.rest)]

    def motion(self, sample: SequenceSample) -> GroundTruth:
        """True motion of a sample's sequence in all frames; raises DataError where it is unknown."""
        if sample.sequence_id not in self._known:
            if len(self._known) >= MOST_KNOWN:
                self._known.pop(next(iter(self._known)))
            truth = self._read(sample.sequence_id)
            if truth is None:
                raise DataError(
                    f"{sample.object_name}/{sample.sequence_name}: its true motion is not known (ground_truth.npz and "
                    "the object's rest points), so it cannot be trained on points. Use supervision=images."
                )
            self._known[sample.sequence_id] = truth
        return self._known[sample.sequence_id]


class _PointComparison:
    """Loss of a rollout's predicted points, stretch by stretch."""

    def __init__(
        self,
        batch: SceneBatch,
        truths: Sequence[GroundTruth],
        attached: Sequence[Int[Tensor, " _"]],
        scales: Sequence[float],
        energy_weight: float,
    ) -> None:
        self._batch, self._truths, self._scales = batch, truths, scales
        self._energy_weight = energy_weight
        self._kernels, self._units, self._offsets = [], [], []
        for member, truth, kernel in zip(batch.members, truths, attached, strict=True):
            unit = member.unit_of_kernel.to(kernel.device)
            self._kernels.append(kernel + member.kernels.start)
            self._units.append(unit[kernel] + member.units.start)
            self._offsets.append(truth.rest - batch.rest[self._kernels[-1]])
        self._last = [truth.positions[0] for truth in truths]

    def __call__(self, states: States, start: int) -> tuple[Float[Tensor, "T S"], Float[Tensor, ""]]:
        """Loss of each predicted frame and member, and the squared change of the predicted points (summed)."""
        losses, motion = [], states.positions.new_zeros(())
        for i, (truth, scale) in enumerate(zip(self._truths, self._scales, strict=True)):
            turned = states.deformation_gradients[:, self._units[i]] @ self._offsets[i][..., None]
            points = states.positions[:, self._kernels[i]] + turned[..., 0]
            span = slice(start + 1, start + 1 + len(points))
            steps = torch.cat((self._last[i][None], points)).diff(dim=0)
            loss = _squared(points - truth.positions[span])
            if self._energy_weight:
                true_steps = truth.positions[start : span.stop].diff(dim=0)
                still, energies = _squared(truth.positions[span] - truth.rest), (_squared(steps), _squared(true_steps))
                loss = loss + self._energy_weight * still * _energy_mismatch(*energies)
            losses.append(scale * loss)
            motion += scale * _squared(steps.detach()).sum()
            self._last[i] = points[-1].detach()
        return torch.stack(losses, 1), motion


def _energy_mismatch(made: Float[Tensor, " T"], true: Float[Tensor, " T"]) -> Float[Tensor, ""]:
    """Squared logarithm of predicted over true motion energy, averaged over the two halves of T frames."""
    halves = [half for half in zip(made.tensor_split(2), true.tensor_split(2), strict=True) if len(half[0])]
    energies = torch.stack([torch.stack((a.mean(), b.mean())) for a, b in halves])
    least = LEAST_RATIO * energies[:, 1].clamp_min(torch.finfo(true.dtype).tiny)
    return ((energies[:, 0] + least) / (energies[:, 1] + least)).log().square().mean()


def _nearest(points: Float[Tensor, "P 3"], others: Float[Tensor, "Q 3"]) -> Int[Tensor, " P"]:
    return torch.cat([torch.cdist(part, others).argmin(1) for part in points.split(1024)])


def _squared(vectors: Float[Tensor, "T P 3"]) -> Float[Tensor, " T"]:
    return vectors.square().sum(-1).mean(-1)
