"""The ballistic prediction: a rigid body that flies on as last seen, and stays where it meets the floor."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gausim.core import Forces, GaussianScene, SimState, Trajectory
from gausim.core.surroundings import best_rotation


class BallisticDynamics:
    """The rest shape in rigid flight: constant spin, constant velocity under gravity, no bounce.

    Position and orientation in the two given frames are the best rigid fit of the rest shape (Kabsch). Where its lowest
    kernel meets the floor from above, the body stops for good.

    Args:
        scene: the rest scene with its surroundings; gravity that is trained counts as its initial value.
        fps: frames per second of the trajectory.
    """

    def __init__(self, scene: GaussianScene, *, fps: float) -> None:
        self.rest: Tensor = scene.means
        self.surroundings, self.fps = scene.surroundings, fps
        self._solid = scene.simulated

    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """``steps`` + 1 frames, the rigid fit to ``initial`` first; forces are ignored."""
        own = self._solid
        rotation, centre = rigid_fit(self.rest[own], initial.positions[own])
        before, centre_before = rigid_fit(self.rest[own], initial.previous[own])
        offset = self.rest.double() - self.rest[own].double().mean(0)
        spin = rotation @ before.mT
        pull = torch.tensor(self.surroundings.gravity or (0.0, 0.0, 0.0)).to(centre) / self.fps**2
        move = centre - centre_before
        rotations, positions = [rotation], [centre + offset @ rotation.mT]
        for _ in range(steps):
            # Verlet's step, exact in uniform gravity.
            move = move + pull
            rotation, centre = spin @ rotation, centre + move
            depth = self._depth(centre + offset[own] @ rotation.mT, move)
            if depth > 0:
                centre, move = centre + depth * self._up(centre), torch.zeros_like(move)
                spin, pull = torch.eye(3).to(spin), torch.zeros_like(pull)
            rotations.append(rotation)
            positions.append(centre + offset @ rotation.mT)
        turned = torch.stack(rotations)[:, None].to(self.rest)
        # The last unit is for kernels that never move.
        turned = torch.cat((turned, torch.eye(3).to(turned).expand_as(turned)), 1)
        moved = torch.where(own[:, None], torch.stack(positions).to(self.rest), self.rest)
        return Trajectory(moved, turned, turned, (~own).long(), self.fps)

    def _up(self, like: Tensor) -> Float[Tensor, " 3"]:
        floor = self.surroundings.floor
        return like.new_tensor((0.0, 0.0, 0.0) if floor is None else floor.normal)

    def _depth(self, positions: Float[Tensor, "K 3"], move: Float[Tensor, " 3"]) -> float:
        """How far a sinking body is below the floor; 0 for a rising one [scene units]."""
        floor = self.surroundings.floor
        if floor is None or float(move @ self._up(move)) >= 0:
            return 0.0
        return max(0.0, -float(floor.height(positions).min()))


def rigid_fit(rest: Float[Tensor, "P 3"], moved: Float[Tensor, "P 3"]) -> tuple[Tensor, Tensor]:
    """Rotation R (3, 3) and centre c (3,) that minimise sum |R (X - mean X) + c - x|^2, in float64 (Kabsch)."""
    offset, centre = rest.double() - rest.double().mean(0), moved.double().mean(0)
    return best_rotation(moved.double() - centre, offset), centre
