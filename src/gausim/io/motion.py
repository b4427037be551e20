"""A motion as that of its units: twelve numbers per unit and frame.

Every kernel follows exactly one unit, x_k = x_c + G_c (X_k - X_c) with covariance G_c S_k G_c^T, so that the units'
centres and deformation gradients are the whole motion.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from gausim.core import DataError, DivergenceError, GaussianScene, Trajectory

# Kernels that leave the motion of their unit by more than this get a unit of their own [diagonals].
_FOLLOWS = 2e-4


@dataclass(frozen=True, eq=False)
class UnitMotion:
    """The motion of N units over F frames, and the unit that every kernel follows."""

    rest_centres: Float[Tensor, "N 3"]  # X_c, mean of the kernels of each unit at rest [scene units]
    displacements: Float[Tensor, "F N 3"]  # x_c - X_c of every frame [scene units]
    deformation_gradients: Float[Tensor, "F N 3 3"]  # G_c of every frame
    unit_of_kernel: Int[Tensor, " K"]  # the unit of each kernel

    @staticmethod
    def of(scene: GaussianScene, trajectory: Trajectory) -> "UnitMotion":
        """The units' motion of a trajectory; a kernel that does not follow its unit becomes a unit of its own.

        Raises:
            DataError: the trajectory is of another scene.
            DivergenceError: a frame is not finite.
        """
        check_trajectory(scene, trajectory)
        positions, gradients = trajectory.positions.float(), trajectory.deformation_gradients.float()
        made = _averaged(scene.means, positions, gradients, trajectory.unit_of_kernel)
        leaves = torch.zeros(scene.count)
        for frame, now in zip(range(len(positions)), made.positions(scene.means), strict=True):
            leaves = torch.maximum(leaves, (now - positions[frame]).norm(dim=-1))
        alone = (leaves > _FOLLOWS * scene.diagonal).nonzero()[:, 0]
        if not len(alone):
            return made
        unit = trajectory.unit_of_kernel.clone()
        gradients = torch.cat((gradients, gradients[:, unit[alone]]), 1)
        unit[alone] = torch.arange(gradients.shape[1] - len(alone), gradients.shape[1])
        return _averaged(scene.means, positions, gradients, unit)

    def positions(self, rest: Float[Tensor, "K 3"]) -> Iterator[Float[Tensor, "K 3"]]:
        """x_c + G_c (X_k - X_c) of all kernels, frame by frame [scene units]; exactly X_k where nothing moves."""
        unit, offset = self.unit_of_kernel, (rest - self.rest_centres[self.unit_of_kernel])[..., None]
        for moved, gradients in zip(self.displacements, self.deformation_gradients - torch.eye(3), strict=True):
            yield rest + moved[unit] + (gradients[unit] @ offset)[..., 0]


def motion_arrays(scene: GaussianScene, trajectory: Trajectory) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    """Arrays and numbers of a motion, besides the rest scene: twelve numbers per unit and frame.

    ``centres`` (N, 3) are the units' centres at rest and ``origins`` (F, 3) what all displacements of a frame have in
    common [scene units], ``moved`` (F, N, 12) the rest of the displacements [diagonals] and G - I.

    Raises:
        DataError: the trajectory is of another scene, or goes beyond half floats.
        DivergenceError: a frame is not finite.
    """
    motion = UnitMotion.of(scene, trajectory)
    moved = motion.displacements
    # Half floats are relative: what all units have in common is stored apart where a body travels far.
    origins = (moved.amax(1) + moved.amin(1)) / 2
    if float(moved.abs().max()) < scene.diagonal:
        origins = torch.zeros_like(origins)
    parts = (moved - origins[:, None]) / scene.diagonal, (motion.deformation_gradients - torch.eye(3)).flatten(2)
    units = torch.cat(parts, 2)
    if not bool(torch.isfinite(units.half()).all()):
        raise DataError(f"{scene.name}: the motion is beyond half floats (65504). Export it as ply.")
    values = {
        "centres": motion.rest_centres,
        "origins": origins,
        "moved": units,
        "unit_of_kernel": motion.unit_of_kernel,
    }
    facts: dict[str, object] = {
        "fps": trajectory.fps, "frames": trajectory.frames, "units": len(motion.rest_centres),
        "diagonal": scene.diagonal,
    }  # fmt: skip
    return {name: value.numpy() for name, value in values.items()}, facts


def _averaged(rest: Tensor, positions: Tensor, gradients: Tensor, unit: Tensor) -> UnitMotion:
    """Units' centres and displacements as means over their kernels; zero for units without kernels."""
    count = gradients.shape[1]
    members = torch.zeros(count).index_add(0, unit, torch.ones(len(unit))).clamp_min(1)[:, None]
    centres = torch.zeros(count, 3, dtype=torch.float64).index_add(0, unit, rest.double()) / members
    # x_c - X_c = mean of x_k - X_k, since the offsets of a unit's kernels from their mean sum to zero.
    moved = torch.zeros(len(positions), count, 3, dtype=torch.float64)
    for frame, now in zip(moved, positions, strict=True):
        frame.index_add_(0, unit, now.double() - rest.double())
    return UnitMotion(centres.float(), (moved / members).float(), gradients, unit)


def check_trajectory(scene: GaussianScene, trajectory: Trajectory) -> None:
    """Checks that a trajectory can be exported with a scene.

    Raises:
        DataError: it is of another scene.
        DivergenceError: a frame is not finite.
    """
    if trajectory.positions.shape[1] != scene.count:
        raise DataError(
            f"{scene.name}: has {scene.count} kernels, the trajectory {trajectory.positions.shape[1]}. Give the scene "
            "that it was made with."
        )
    for values in (trajectory.positions, trajectory.deformation_gradients):
        bad = ~torch.isfinite(values).reshape(trajectory.frames, -1).all(-1)
        if bool(bad.any()):
            raise DivergenceError(f"{scene.name}: frame {int(bad.nonzero()[0])} is not finite; it cannot be shown.")
