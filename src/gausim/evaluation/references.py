"""Reference of an object: what a prediction without dynamics gives, from which every table counts."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gausim.baselines.references import ballistic_motion, hands_motion, rigid_fit, static_motion
from gausim.core import GaussianScene, SimState, Trajectory
from gausim.data.objects import ObjectData
from gausim.data.records import GroundTruth, SequenceRecord
from gausim.metrics import Bounce, bounce
from gausim.results.curves import BALLISTIC, FOLLOW_HANDS, TRUTH
from gausim.results.table import STATIC


class Reference:
    """The reference prediction of an object.

    * ``follow hands``, of a body in hands: :func:`gausim.baselines.references.hands_motion`.
    * ``ballistic``, of a free body whose motion is known: seen frames are the rigid flight from the true frames 0 and 1
      on, unseen ones that from the last two seen frames on (:func:`gausim.baselines.references.ballistic_motion`).
    * ``static``, of all others: the rest state.
    """

    def __init__(self, data: ObjectData, scene: GaussianScene) -> None:
        """Chooses the reference of an object; ``scene`` is its rest scene."""
        self._scene, self._fps, self._seen = scene, data.fps, data.train_frames.stop
        self.name = STATIC  # its row in tables
        if any(record.hands is not None for record in data.sequences):
            self.name = FOLLOW_HANDS
        elif data.surroundings.free:
            shown = [record for record in data.sequences if record.limit is None]  # not of a sealed test part
            self.name = BALLISTIC if all(data.ground_truth(record) is not None for record in shown) else STATIC

    def trajectory(self, record: SequenceRecord, truth: GroundTruth | None) -> Trajectory:
        """Its prediction of a sequence."""
        if self.name == FOLLOW_HANDS and record.hands is not None:
            return hands_motion(self._scene, record.hands, fps=self._fps, steps=record.count - 1)
        if self.name == BALLISTIC and truth is not None:
            return self._flight(truth, record.count)
        return static_motion(self._scene, fps=self._fps, steps=record.count - 1)

    def _flight(self, truth: GroundTruth, count: int) -> Trajectory:
        seen = min(self._seen, count)

        def states(first: int, now: int, stop: int) -> Trajectory:
            """Flight from frames ``first`` and ``now`` on, beginning with frame ``now``."""
            state = SimState(self._placed(truth, now), self._placed(truth, first))
            return ballistic_motion(self._scene, state, fps=self._fps, steps=stop - 1 - now)

        parts = (states(0, 0, 1), states(0, 1, seen), states(seen - 2, seen - 1, count))

        def joined(field: str) -> Tensor:
            """The last part begins with the last seen frame, which the one before has already."""
            return torch.cat([getattr(part, field)[int(part is parts[2]) :] for part in parts])

        turned = joined("rotations")
        return Trajectory(joined("positions"), turned, turned, parts[0].unit_of_kernel, self._fps)

    def _placed(self, truth: GroundTruth, frame: int) -> Float[Tensor, "K 3"]:
        """The rest kernels where the true points are in a frame, as a rigid body."""
        rotation, centre = rigid_fit(truth.rest, truth.positions[frame])
        rest = self._scene.means
        moved = (rest.double().cpu() - truth.rest.double().mean(0)) @ rotation.mT + centre
        return moved.to(rest)


class Bounces:
    """Bounces of all sequences of a free body that falls on a floor; of others nothing."""

    def __init__(self, data: ObjectData) -> None:
        self._floor = data.surroundings.floor if data.surroundings.free else None
        self._found: dict[str, list[Bounce]] = {}
        self._diagonal = 1.0

    def add(self, points: Mapping[str, Float[Tensor, "F P 3"]], diagonal: float) -> None:
        """Adds the points of every row, and of the truth, in one sequence."""
        self._diagonal = diagonal
        floor = self._floor
        if floor is None:
            return
        for name, positions in points.items():
            heights = floor.height(positions.double()).cpu().numpy()
            self._found.setdefault(name, []).append(bounce(heights, diagonal))

    def summary(self) -> dict[str, dict[str, float | None]]:
        """The figures of every row and of the truth; empty without a floor."""
        if not self._found:
            return {}
        true = self._found[TRUTH]
        return {
            name: {
                "height": _mean([b.height for b in own]),
                "rise": _mean([b.rise for b in own]),
                "height_error": _mean([abs(b.height / t.height - 1) for b, t in zip(own, true, strict=True)]),
                "rise_error": _mean([abs(b.rise / t.rise - 1) for b, t in zip(own, true, strict=True)]),
                "depth": 100 * max(b.depth for b in own) / self._diagonal,
            }
            for name, own in self._found.items()
        }


def _mean(values: Sequence[float]) -> Any:
    known = np.array(values)[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
