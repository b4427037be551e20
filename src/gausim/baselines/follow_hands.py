"""The static prediction of a body in hands: every kernel follows the hands at once, without dynamics."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from gausim.core import Forces, GaussianScene, HandPath, SimState, Trajectory
from gausim.ops.rotation import rotation_of, rotation_vector


class FollowHandsDynamics:
    """Kernels move by the mean of the hands' motions, weighted by the inverse distance w_g to what each hand holds.

    With hand g at c_g, turned by exp(theta_g) about o_g, kernel X goes to
    X + sum_g w_g (c_g - o_g + (exp(w_g theta_g) - I) (X - o_g)): exactly with its hand where it is held, and between
    two hands as far apart as a beam is long, along the beam's static deflection by turned ends. Pins that no hand moves
    count as a hand that stands still.

    Args:
        scene: the rest scene; its field ``hand`` tells what each hand holds.
        hands: recorded path of the hands.
        fps: frames per second of the trajectory.
    """

    def __init__(self, scene: GaussianScene, hands: HandPath, *, fps: float) -> None:
        self.rest: Tensor = scene.means
        self.hands, self.fps = hands, fps
        self.weights = hand_weights(scene)

    def rollout(self, initial: SimState, steps: int, *, forces: Forces | None = None) -> Trajectory:
        """``steps`` + 1 frames from frame 0 of the hands on; ``initial`` and forces are ignored."""
        rest, positions, rotations = self.rest, [], []
        for frame in range(steps + 1):
            pose = self.hands.pose(frame).to(rest)
            moved, turn = rest, torch.zeros_like(rest)
            for number, weight in enumerate(self.weights.unbind(1)):
                theta = weight[:, None] * rotation_vector(pose.rotations[number])
                offset = rest - pose.origins[number]
                turned = (rotation_of(theta) @ offset[..., None])[..., 0] - offset
                moved = moved + weight[:, None] * (pose.centres[number] - pose.origins[number] + turned)
                turn = turn + theta
            positions.append(moved)
            rotations.append(rotation_of(turn))
        turned = torch.stack(rotations)
        units = torch.arange(len(rest), device=rest.device)
        return Trajectory(torch.stack(positions), turned, turned, units, self.fps)


def hand_weights(scene: GaussianScene) -> Float[Tensor, "K G"]:
    """Weight of every hand for each kernel: inverse distances to the nearest kernel that it holds, sum at most 1.

    What is missing to 1 is the weight of the pins that no hand moves, and all of it for kernels that are not simulated.
    """
    hand = torch.full_like(scene.pinned, -1, dtype=torch.long) if scene.hand is None else scene.hand
    holders = sorted(set(hand[scene.pinned].tolist()))
    means = scene.means.cpu().numpy()
    trees = [cKDTree(means[(scene.pinned & (hand == g)).cpu().numpy()]) for g in holders]
    distance = torch.from_numpy(np.stack([tree.query(means)[0] for tree in trees], 1)).to(scene.means)
    nearness = 1 / distance.clamp_min(1e-6 * scene.diagonal)
    weights = nearness / nearness.sum(1, keepdim=True)
    for column, holder in enumerate(holders):
        held = scene.pinned & (hand == holder)
        weights[held] = torch.eye(len(holders)).to(weights)[column]
    weights = weights * scene.simulated[:, None]
    return weights[:, 1:] if holders[0] < 0 else weights
